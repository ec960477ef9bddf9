"""Checks of straight edges in joint space: fast checks at samples, and proofs.

``edge_is_free`` checks postures on the edge with a reserve beside the margin. An edge that passes
is almost always free, but that is no proof: a thin obstacle may be between two postures.
``edge_is_proven`` is the proof (``certificate.py``).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.certificate import PROOF, prove_segment
from robot_ik.kernels.collision import FREE, verdict
from robot_ik.kernels.collision import RUN as COLLISION
from robot_ik.kernels.jit import inlined, kernel, outlined

EDGE_CHECK = Layout(
    "EdgeCheck",
    margin="float",  # m, of the proofs
    reserve="float",  # m, added to the margin at samples
    resolution="float",  # rad or m, largest distance of two samples
    checks="int",  # samples that were checked
    sample="floats nq",
    change="floats nq",
    samples=COLLISION,  # memory of the checks at samples; a proof lists more pairs in its memory
    proof=PROOF,
)
open_edge_check = EDGE_CHECK.open


@inlined
def distance_between(first, last):
    """Return the Euclidean distance of two postures (nq,)."""
    square = 0.0
    for j in range(first.shape[0]):
        change = last[j] - first[j]
        square += change * change
    return math.sqrt(square)


@inlined
def write_between(first, last, share, out):
    """Write the posture at a share of the edge from ``first`` to ``last`` to ``out`` (nq,)."""
    for j in range(out.shape[0]):
        out[j] = first[j] + share * (last[j] - first[j])


@outlined
def sample_is_free(edges, q):
    """Return whether a posture (nq,) keeps the margin and the reserve."""
    edges.checks += 1
    return verdict(edges.samples, q, edges.margin + edges.reserve) == FREE


@outlined
def edge_is_free(edges, first, last):
    """Return whether the samples of an edge are free, without its first posture.

    The end is checked first, then the middle, then the quarters: neighbours of a free sample are
    probably free, so distant samples find a contact earlier.
    """
    if not sample_is_free(edges, last):
        return False
    count = math.ceil(distance_between(first, last) / edges.resolution)
    stride = 1
    while stride < count:
        stride *= 2
    while stride > 1:
        half = stride // 2
        for k in range(half, count, stride):
            write_between(first, last, k / count, edges.sample)
            if not sample_is_free(edges, edges.sample):
                return False
        stride = half
    return True


@outlined
def edge_is_proven(edges, first, last):
    """Return whether an edge is proven to keep the margin."""
    for j in range(first.shape[0]):
        edges.change[j] = last[j] - first[j]
    return prove_segment(edges.proof, first, edges.change, edges.margin) == FREE


@kernel
def unproven_edge(address, path):
    """Return the index of the first edge of a path (n, nq) that is not proven, or -1."""
    edges = open_edge_check(address)
    for k in range(path.shape[0] - 1):
        edges.proof.checks = 0
        if not edge_is_proven(edges, path[k], path[k + 1]):
            return k
    return -1
