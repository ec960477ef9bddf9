"""Shortcuts, which make a path of straight edges shorter.

First each corner is connected to the farthest later corner that a free edge reaches. Then two
random points of the path are repeatedly connected by a straight edge, if that edge is free
(Geraerts & Overmars, Creating high-quality paths for motion planning, 2007).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.path_edges import (
    EDGE_CHECK,
    distance_between,
    edge_is_free,
    edge_is_proven,
    sample_is_free,
    write_between,
)
from robot_ik.kernels.search import uniform

# Smallest gain of a shortcut, a share of the length that it replaces.
_SMALLEST_GAIN = 1e-3

# With nq, w corners at most.
SHORTCUT = Layout(
    "Shortcut",
    count="int",  # corners
    random_state="int",
    proven="bool",  # accept proven edges only
    path="table w nq",
    first="floats nq",
    last="floats nq",
    edges=EDGE_CHECK,
)
open_shortcut = SHORTCUT.open


@outlined
def is_accepted(shortcut, first, last):
    """Return whether an edge may become a part of the path."""
    edges = shortcut.edges
    if not edge_is_free(edges, first, last):
        return False
    if not shortcut.proven:
        return True
    edges.proof.checks = 0
    return edge_is_proven(edges, first, last)


@outlined
def replace_corners(shortcut, after, before, count):
    """Keep ``count`` new corners between two corners, and move the later corners there."""
    path = shortcut.path
    shift = after + 1 + count - before
    if shift < 0:
        for k in range(before, shortcut.count):
            for j in range(path.shape[1]):
                path[k + shift, j] = path[k, j]
    elif shift > 0:
        for k in range(shortcut.count - 1, before - 1, -1):
            for j in range(path.shape[1]):
                path[k + shift, j] = path[k, j]
    shortcut.count += shift


@outlined
def skip_corners(shortcut):
    """Connect each corner to the farthest later corner that an accepted edge reaches."""
    path = shortcut.path
    first = 0
    while first < shortcut.count - 2:
        last = shortcut.count - 1
        while last > first + 1:
            if is_accepted(shortcut, path[first], path[last]):
                replace_corners(shortcut, first, last, 0)
                break
            last -= 1
        first += 1


@outlined
def edge_at(shortcut, length):
    """Return the edge at a length along the path, and the share of the edge."""
    path = shortcut.path
    last = shortcut.count - 2
    for k in range(last):
        edge = distance_between(path[k], path[k + 1])
        if length < edge:
            return k, length / edge
        length -= edge
    edge = distance_between(path[last], path[last + 1])
    return last, min(1.0, length / max(edge, 1e-300))


@outlined
def length_of(shortcut):
    """Return the length of the path."""
    length = 0.0
    for k in range(shortcut.count - 1):
        length += distance_between(shortcut.path[k], shortcut.path[k + 1])
    return length


@outlined
def try_shortcut(shortcut, length):
    """Connect two random points of a path of this length; return the gain in length, or 0."""
    path = shortcut.path
    if shortcut.count + 2 > path.shape[0]:
        return 0.0
    begin = length * uniform(shortcut)
    end = length * uniform(shortcut)
    if begin > end:
        begin, end = end, begin
    a, share_a = edge_at(shortcut, begin)
    b, share_b = edge_at(shortcut, end)
    if a == b:
        return 0.0
    write_between(path[a], path[a + 1], share_a, shortcut.first)
    write_between(path[b], path[b + 1], share_b, shortcut.last)
    gain = end - begin - distance_between(shortcut.first, shortcut.last)
    if gain < _SMALLEST_GAIN * (end - begin):
        return 0.0
    if not sample_is_free(shortcut.edges, shortcut.first):
        return 0.0
    if not is_accepted(shortcut, shortcut.first, shortcut.last):
        return 0.0
    replace_corners(shortcut, a, b + 1, 2)
    for j in range(path.shape[1]):
        path[a + 1, j] = shortcut.first[j]
        path[a + 2, j] = shortcut.last[j]
    return gain


@kernel
def shorten(address, tries, patience):
    """Shorten the path by at most ``tries`` random shortcuts; end after ``patience`` failures."""
    shortcut = open_shortcut(address)
    skip_corners(shortcut)
    length = length_of(shortcut)
    failures = 0
    for _ in range(tries):
        if shortcut.count < 3 or failures >= patience:
            break
        gain = try_shortcut(shortcut, length)
        length -= gain
        failures = 0 if gain > 0.0 else failures + 1
    skip_corners(shortcut)
