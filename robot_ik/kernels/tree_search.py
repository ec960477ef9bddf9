"""RRT-Connect: two trees of free postures grow towards each other in joint space.

Kuffner & LaValle, RRT-Connect: an efficient approach to single-query path planning, 2000. One tree
grows from the start, the other from all goal postures. Each iteration draws a random posture,
extends one tree towards it by one edge, and then extends the other tree to the new node until an
edge is blocked. The smaller tree is extended towards the random posture.

Edges are checked at samples. The caller proves the edges of a path and removes those that are
refuted (``REMOVED``). Then the search goes on.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import follow
from robot_ik.kernels.path_edges import (
    EDGE_CHECK,
    distance_between,
    edge_is_free,
    write_between,
)
from robot_ik.kernels.search import uniform

# Parents that are not nodes.
ROOT = -1
REMOVED = -2

# With nq, c nodes at most.
NODES = Layout(
    "Nodes",
    count="int",
    q="table c nq",
    parent="ints c",  # a node, ROOT or REMOVED
)

TREE_SEARCH = Layout(
    "TreeSearch",
    iterations="int",  # random postures so far
    random_state="int",
    longest="float",  # rad or m, longest edge
    root="int",  # goal root for the next straight edge from the start
    start_node="int",  # nodes at which the trees meet
    goal_node="int",
    lower="floats nq",  # box of the random postures
    upper="floats nq",
    target="floats nq",
    fresh="floats nq",
    start_tree=NODES,
    goal_tree=NODES,
    edges=EDGE_CHECK,
)
open_tree_search = TREE_SEARCH.open


@outlined
def nearest_node(nodes, q):
    """Return the node nearest to a posture (nq,)."""
    nearest = -1
    smallest = math.inf
    width = q.shape[0]
    for i in range(nodes.count):
        square = 0.0
        for j in range(width):
            change = nodes.q[i, j] - q[j]
            square += change * change
        if square < smallest and nodes.parent[i] != REMOVED:
            smallest = square
            nearest = i
    return nearest


@outlined
def add_node(nodes, q, parent):
    """Append a node and return its index."""
    node = nodes.count
    for j in range(q.shape[0]):
        nodes.q[node, j] = q[j]
    nodes.parent[node] = parent
    nodes.count += 1
    return node


@inlined
def draw_target(search):
    """Write a random posture of the box to search.target."""
    for j in range(search.target.shape[0]):
        width = search.upper[j] - search.lower[j]
        search.target[j] = search.lower[j] + width * uniform(search)
    follow(search.edges.samples.tree, search.target)


@outlined
def extend(search, nodes, node, target):
    """Add a node between a node and ``target`` (nq,); return it, or -1 if the edge is blocked."""
    distance = distance_between(nodes.q[node], target)
    share = min(1.0, search.longest / max(distance, 1e-300))
    write_between(nodes.q[node], target, share, search.fresh)
    if not edge_is_free(search.edges, nodes.q[node], search.fresh):
        return -1
    return add_node(nodes, search.fresh, node)


@outlined
def connect(search, nodes, target):
    """Extend a tree to ``target`` (nq,) in edges; return the node there, or -1 if it is blocked."""
    node = nearest_node(nodes, target)
    while nodes.count < nodes.q.shape[0]:
        distance = distance_between(nodes.q[node], target)
        if distance <= 0.0:
            return node
        # Edges of equal length.
        count = math.ceil(distance / search.longest)
        write_between(nodes.q[node], target, 1.0 / count, search.fresh)
        if count == 1:
            for j in range(target.shape[0]):
                search.fresh[j] = target[j]
        if not edge_is_free(search.edges, nodes.q[node], search.fresh):
            return -1
        node = add_node(nodes, search.fresh, node)
        if count == 1:
            return node
    return -1


@kernel
def begin_search(address, start, goals, random_state):
    """Begin with new trees: the start (nq,), and the goal postures (g, nq), nearest first."""
    search = open_tree_search(address)
    search.random_state = random_state
    search.root = 0
    search.start_tree.count = 0
    search.goal_tree.count = 0
    add_node(search.start_tree, start, ROOT)
    for k in range(goals.shape[0]):
        add_node(search.goal_tree, goals[k], ROOT)


@kernel
def join_straight(address, goals):
    """Return whether a straight edge from the start to one of ``goals`` roots is free."""
    search = open_tree_search(address)
    while search.root < goals:
        root = search.root
        search.root += 1
        if edge_is_free(search.edges, search.start_tree.q[0], search.goal_tree.q[root]):
            search.start_node = 0
            search.goal_node = root
            return True
    return False


@kernel
def grow_trees(address, iterations):
    """Grow both trees for a number of iterations; return whether they met.

    Ends early if a tree is full.
    """
    search = open_tree_search(address)
    start_tree = search.start_tree
    goal_tree = search.goal_tree
    for _ in range(iterations):
        if is_full(start_tree) or is_full(goal_tree):
            return False
        search.iterations += 1
        from_start = start_tree.count <= goal_tree.count
        growing = start_tree if from_start else goal_tree
        other = goal_tree if from_start else start_tree
        draw_target(search)
        node = extend(search, growing, nearest_node(growing, search.target), search.target)
        if node < 0:
            continue
        joined = connect(search, other, growing.q[node])
        if joined >= 0:
            search.start_node = node if from_start else joined
            search.goal_node = joined if from_start else node
            return True
    return False


@inlined
def is_full(nodes):
    """Return whether a tree has no room for another node."""
    return nodes.count >= nodes.q.shape[0]
