"""From a frame to marker observations, picture after picture.

``tracker`` detects, refines and estimates; ``flips`` remembers both poses of a flat marker, so that a
lucky error does not flip it; ``sightings`` tells in plain values what is in a picture, and draws it.
"""

from robot_ik.camera.track.tracker import Layout, MarkerTracker

__all__ = [
    "Layout",
    "MarkerTracker",
]
