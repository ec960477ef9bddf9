"""Reachability maps: in which poses a frame of an arm can stand, cell by cell."""
