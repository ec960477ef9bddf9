"""Motions of figures: motion capture files, retargeting, pose priors, dragging by hand."""
