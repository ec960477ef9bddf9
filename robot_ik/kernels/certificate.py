"""Proof that a motion is free: distance against a bound of the motion, by bisection.

Schwarzer, Saha & Latombe, Adaptive dynamic collision checking, 2005. Along a straight line in joint
space a pair of links is free in an interval if at its middle

    distance > margin + motion of the first link + motion of the second

Each motion is a bound for half the interval, in the frame of the last node that carries both links.
From the link towards that node each joint adds to the bound d

    hinge, ball    angle · (lever + d)       slide    |Δq|       free    both

where the lever is the largest distance of the link's capsule from the axis or centre, at the
middle: during the half interval no point of the link comes farther from it than lever + d. If a
pair fails, the interval is halved. Pairs before it are proven for both halves.

A coupled joint moves as its leader determines. Its largest slope on the line bounds its motion.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.collision import (
    FREE,
    TOUCHING,
    UNDECIDED,
    begin_check,
    next_pair,
    pair_bounds,
    restart_scan,
)
from robot_ik.kernels.collision import RUN as COLLISION
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import follow, integrate, steepest_slope
from robot_ik.kernels.tree import BALL, HINGE, SLIDE

# m. A pair that moves less than this in an interval and is not proven free cannot be proven.
_SMALLEST_MOTION = 1e-6
# m. Added to each bound against rounding.
_ROUNDING = 1e-9
# Depth of the stack: the largest number of halvings of an interval.
STACK_DEPTH = 64

# With nq, nv, l links, n nodes, h the depth of the stack.
PROOF = Layout(
    "Proof",
    checks="int",  # postures that were checked
    max_checks="int",
    segment="int",  # where the proof ended: segment of the path,
    share="float",  # … and share of this segment
    pair="int",  # the pair of geoms that is not proven free there
    q="floats nq",
    change="floats nv",  # change along the whole line, or a bound of it for a coupled joint
    step="floats nv",  # share of the change
    stack="table h 3",  # intervals: middle, half their length, pairs of links that are proven
    travel="table l n",  # bound of the motion of a link relative to the parent of a node
    collision=COLLISION,
)
open_proof = PROOF.open


@inlined
def lever_of(tree, check, radius, link, node):
    """Return the largest distance of a link's capsule from the axis or centre of a joint."""
    origin = so3.read_vector(check.world, node, 0)
    first = so3.subtract(so3.read_vector(check.ends, link, 0), origin)
    last = so3.subtract(so3.read_vector(check.ends, link, 3), origin)
    if tree.kind[node] == HINGE:
        axis = so3.z_axis(so3.read_rotation(check.world, node))
        first = so3.cross(axis, first)
        last = so3.cross(axis, last)
    return math.sqrt(max(so3.dot(first, first), so3.dot(last, last))) + radius


@outlined
def write_change(proof, start, dq):
    """Write proof.change of the line from ``start`` (nq,) along ``dq`` (nv,)."""
    tree = proof.collision.tree
    for v in range(dq.shape[0]):
        proof.change[v] = dq[v]
    for c in range(tree.coupled.shape[0]):
        leader = tree.coupled[c, 1]
        travel = 0.0
        if leader >= 0:
            first = start[tree.qadr[leader]]
            turn = dq[tree.vadr[leader]]
            travel = steepest_slope(tree, c, first, first + turn) * abs(turn)
        proof.change[tree.vadr[tree.coupled[c, 0]]] = travel


@outlined
def bound_motion(proof, half):
    """Write the largest approach of each pair of links in half an interval of length ``half``.

    The collision check must have placed the links at the middle of the interval.
    """
    run = proof.collision
    tree = run.tree
    check = run.check
    shapes = run.shapes
    dq = proof.change
    for link in range(shapes.node.shape[0]):
        node = shapes.node[link]
        bound = 0.0
        while node >= 0:
            v = tree.vadr[node]
            joint = tree.kind[node]
            if joint == SLIDE:
                bound += half * abs(dq[v])
            else:
                turn = abs(dq[v])
                if joint != HINGE:
                    w = v if joint == BALL else v + 3
                    turn = so3.norm(so3.read_vector_at(dq, w))
                lever = lever_of(tree, check, shapes.capsule[link, 6], link, node)
                bound += half * turn * (lever + bound)
                if joint != HINGE and joint != BALL:
                    bound += half * so3.norm(so3.read_vector_at(dq, v))
            proof.travel[link, node] = bound
            node = tree.parent[node]
    below = run.pairs.below
    for k in range(below.shape[0]):
        motion = _ROUNDING
        for side in range(2):
            if below[k, side] >= 0:
                motion += proof.travel[run.pairs.links[k, side], below[k, side]]
        check.motion[k] = motion


@outlined
def prove_segment(proof, start, dq, margin):
    """Return FREE if the line from ``start`` (nq,) along ``dq`` (nv,) keeps the margin.

    TOUCHING: a pair is nearer than the margin at proof.share. UNDECIDED: the distance of a pair is
    so close to the margin there that nothing can be proven.
    """
    run = proof.collision
    check = run.check
    stack = proof.stack
    stack[0, 0] = 0.5
    stack[0, 1] = 0.5
    stack[0, 2] = -1.0
    top = 1
    write_change(proof, start, dq)
    while top > 0:
        top -= 1
        middle = stack[top, 0]
        half = stack[top, 1]
        proven = int(stack[top, 2])
        for i in range(start.shape[0]):
            proof.q[i] = start[i]
        for v in range(dq.shape[0]):
            proof.step[v] = middle * dq[v]
        integrate(run.tree, run.tree.every, proof.q, proof.step)
        follow(run.tree, proof.q)
        begin_check(run, proof.q)
        bound_motion(proof, half)
        restart_scan(check, proven)
        proof.checks += 1
        while True:
            pair = next_pair(run, margin)
            if pair < 0:
                break
            motion = check.motion[check.link_pair]
            lower, upper, overlap = pair_bounds(run, pair, margin + motion, margin)
            if lower > margin + motion:
                continue
            proof.share = middle
            proof.pair = pair
            if overlap or upper <= margin:
                return TOUCHING
            if (
                motion < _SMALLEST_MOTION
                or top + 2 > stack.shape[0]
                or proof.checks >= proof.max_checks
            ):
                return UNDECIDED
            # The earlier half on top, so that contacts are found in the order of time.
            stack[top, 0] = middle + 0.5 * half
            stack[top + 1, 0] = middle - 0.5 * half
            for i in range(2):
                stack[top + i, 1] = 0.5 * half
                stack[top + i, 2] = check.link_pair - 1
            top += 2
            break
    return FREE


@kernel
def prove_path(address, starts, changes, margin):
    """Return the verdict of a path: lines from ``starts`` (n, nq) along ``changes`` (n, nv).

    Ends at the first line that is not proven free; proof.segment is its index.
    """
    proof = open_proof(address)
    for segment in range(starts.shape[0]):
        proof.segment = segment
        verdict = prove_segment(proof, starts[segment], changes[segment], margin)
        if verdict != FREE:
            return verdict
    return FREE


@kernel
def bound_of_motion(address, q, dq, half):
    """Write check.motion for half an interval with its middle at ``q`` (nq,).

    The whole line is along ``dq`` (nv,), with its middle at ``q`` too.
    """
    proof = open_proof(address)
    for i in range(q.shape[0]):
        proof.q[i] = q[i]
    for v in range(dq.shape[0]):
        proof.step[v] = -0.5 * dq[v]
    integrate(proof.collision.tree, proof.collision.tree.every, proof.q, proof.step)
    write_change(proof, proof.q, dq)
    begin_check(proof.collision, q)
    bound_motion(proof, half)
