"""Reachability maps: which poses a frame of an arm can reach, cell by cell."""
