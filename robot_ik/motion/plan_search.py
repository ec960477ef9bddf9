"""``search_path``: a proven path of straight edges between postures, shortened.

The search runs in slices, so that Ctrl-C and a budget of seconds end it. The result depends on the
seed and the iterations only, not on the slices.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.budget import Budget
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.geometry import Array
from robot_ik.kernels import collision, jit, path_edges, path_shortcut, tree_search
from robot_ik.kernels.block import Block
from robot_ik.motion.certificate import proof_memory

RESERVE = 0.003
"""m. Samples of an edge keep the margin plus this, so that nearly all edges can be proven."""

RESERVE_SHARES = (1.0, 0.25, 0.0)
"""Shares of the reserve, one for each search in turn. A passage may need a small reserve."""

RESOLUTION = 1.0 / 12.0
"""rad or m. Largest distance of two samples of an edge. The samples find most contacts at a low
cost. Every edge of a path is proven afterwards."""

LONGEST_EDGE = 1.0
"""rad or m. Longest edge of a tree."""

FIRST_ITERATIONS = 1024
"""Iterations after which a new search replaces the first. A new search is often quicker than a long
one. After all shares of the reserve have been tried, the number is doubled."""

MAX_DOUBLINGS = 8
"""Largest number of doublings of the iterations. The trees have no room for more."""

MAX_NODES = 16_384
"""Largest number of nodes of a tree. A full tree ends its search."""

SLICE = 64
"""Iterations between two checks of the time: some milliseconds."""

SHORTCUTS = 100
"""Largest number of shortcuts that are tried."""

PATIENCE = 25
"""Failed shortcuts in sequence after which the path counts as short."""

MAX_CORNERS = 512
"""Largest number of corners of a path while it is shortened."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of ``search_path``.

    Attributes:
        corners: (k, nq) the path, whose edges are proven. None if no path was found.
        iterations: Random postures that were drawn.
        restarts: Number of searches after the first.
        nodes: Nodes of the last trees: of the start, and of the goals.
        out_of_time: Whether the seconds ended before the iterations.
    """

    corners: Array | None
    iterations: int
    restarts: int
    nodes: tuple[int, int]
    out_of_time: bool


def search_path(
    collisions: CollisionAvoidance,
    start: Array,
    goals: Array,
    box: tuple[Array, Array],
    budget: Budget,
    seed: int,
) -> SearchResult:
    """Search a path from ``start`` to one of the goal postures.

    Args:
        collisions: The condition.
        start: Joint angles (nq,) that keep the margin.
        goals: Postures (g, nq) that keep the margin, the preferred one first.
        box: Lower and upper limits (nq,) of the postures of the path.
        budget: Its iterations are random postures, its restarts new searches.
        seed: Seed of the random postures.
    """
    return _Search(collisions, start, goals, box, budget, seed).run()


class _Search:
    """Memory and state of one call of ``search_path``."""

    def __init__(
        self,
        collisions: CollisionAvoidance,
        start: Array,
        goals: Array,
        box: tuple[Array, Array],
        budget: Budget,
        seed: int,
    ) -> None:
        self.start = start
        self.goals = goals
        self.budget = budget
        self.states = np.random.SeedSequence(seed)
        self.began = time.perf_counter()
        robot = collisions.scene.robot
        checks = {"samples": collisions.memory(), "proof": proof_memory(collisions)}
        self.edges = path_edges.EDGE_CHECK.allocate({"nq": robot.nq}, checks)
        self.edges["margin"] = collisions.margin
        self.edges["resolution"] = RESOLUTION
        sizes = {"nq": robot.nq, "c": MAX_NODES, "w": MAX_CORNERS}
        given: dict[str, Any] = {
            "edges": self.edges,
            "lower": box[0].copy(),
            "upper": box[1].copy(),
        }
        self.trees = tree_search.TREE_SEARCH.allocate(sizes, given)
        self.trees["longest"] = LONGEST_EDGE
        self.shortcut = path_shortcut.SHORTCUT.allocate(sizes, {"edges": self.edges})
        self.rooms = self._rooms(np.vstack([start, goals]))
        jit.announce(tree_search.grow_trees, "the path search")

    def _rooms(self, postures: Array) -> Array:
        """Return the distance (n,) beyond the margin of postures (n, nq), up to two reserves."""
        address = self.edges.nested["samples"].address
        distances = np.zeros(len(postures))
        nearest = np.zeros(len(postures), dtype=np.int64)
        reach = self.edges["margin"] + 2.0 * RESERVE
        collision.smallest_distances(address, postures, reach, distances, nearest)
        return np.maximum(distances - self.edges["margin"], 0.0)

    def run(self) -> SearchResult:
        """Search until a path is found or the budget ends."""
        restarts = 0
        while True:
            corners = self._search_once(restarts)
            out_of_time = self._is_late()
            is_spent = self.trees["iterations"] >= self.budget.iterations
            is_last = self.budget.restarts is not None and restarts >= self.budget.restarts
            if corners is not None or is_spent or is_last or out_of_time:
                nodes = (self._tree("start_tree")["count"], self._tree("goal_tree")["count"])
                iterations = self.trees["iterations"]
                return SearchResult(corners, iterations, restarts, nodes, out_of_time)
            restarts += 1

    def _tree(self, name: str) -> Block:
        return self.trees.nested[name]

    def _is_late(self) -> bool:
        seconds = self.budget.seconds
        return seconds is not None and time.perf_counter() - self.began >= seconds

    def _search_once(self, restart: int) -> Array | None:
        """Search with new trees; return a short path, or None."""
        # Ends near the margin need a small reserve. Goals that are nearer are left out.
        cycle, number = divmod(restart, len(RESERVE_SHARES))
        share = RESERVE_SHARES[number]
        room = min(self.rooms[0], self.rooms[1:].max())
        reserve = share * min(RESERVE, 0.5 * room)
        self.edges["reserve"] = reserve
        goals = np.ascontiguousarray(self.goals[self.rooms[1:] >= reserve])
        tree_search.begin_search(self.trees.address, self.start, goals, self._random_state())
        limit = FIRST_ITERATIONS * 2 ** min(cycle, MAX_DOUBLINGS)
        end = min(self.budget.iterations, self.trees["iterations"] + limit)
        while True:
            if tree_search.join_straight(self.trees.address, len(goals)):
                joined = True
            elif self.trees["iterations"] >= end or self._is_late() or self._is_full():
                return None
            else:
                count = min(SLICE, end - self.trees["iterations"])
                joined = tree_search.grow_trees(self.trees.address, count)
            if joined:
                path = self._proven_path()
                if path is not None:
                    return self._shortened(path)

    def _is_full(self) -> bool:
        return max(self._tree(name)["count"] for name in ("start_tree", "goal_tree")) >= MAX_NODES

    def _random_state(self) -> int:
        """Return the first state of a generator of the kernels: not 0."""
        return int(self.states.spawn(1)[0].generate_state(1, np.uint64)[0] >> np.uint64(1)) | 1

    def _proven_path(self) -> Array | None:
        """Return the path (k, nq) of the trees that met; None after removing a refuted edge."""
        start_chain = self._chain("start_tree", self.trees["start_node"])[::-1]
        goal_chain = self._chain("goal_tree", self.trees["goal_node"])
        first = self._tree("start_tree").arrays["q"][start_chain]
        last = self._tree("goal_tree").arrays["q"][goal_chain]
        # The node that is removed with each edge. The edge between the trees has no node.
        children = [("start_tree", node) for node in start_chain[1:]]
        if np.array_equal(first[-1], last[0]):
            path = np.vstack([first, last[1:]])
        else:
            path = np.vstack([first, last])
            children.append(("", -1))
        children += [("goal_tree", node) for node in goal_chain[:-1]]
        refuted = path_edges.unproven_edge(self.edges.address, path)
        if refuted < 0:
            return path
        name, node = children[refuted]
        if name:
            self._remove(name, node)
        return None

    def _chain(self, name: str, node: int) -> list[int]:
        """Return a node and its ancestors up to the root."""
        parents = self._tree(name).arrays["parent"]
        chain = []
        while node != tree_search.ROOT:
            chain.append(node)
            node = int(parents[node])
        return chain

    def _remove(self, name: str, node: int) -> None:
        """Remove a node and its descendants."""
        nodes = self._tree(name)
        parents = nodes.arrays["parent"]
        parents[node] = tree_search.REMOVED
        removed = {node}
        for k in range(node + 1, nodes["count"]):
            if int(parents[k]) in removed:
                parents[k] = tree_search.REMOVED
                removed.add(k)

    def _shortened(self, path: Array) -> Array:
        """Return a short path whose edges are proven."""
        if len(path) < 3:
            return path
        corners = self._run_shortcuts(path, proven=False)
        if path_edges.unproven_edge(self.edges.address, corners) < 0:
            return corners
        return self._run_shortcuts(path, proven=True)

    def _run_shortcuts(self, path: Array, *, proven: bool) -> Array:
        """Return a shorter path; ``proven`` accepts proven edges only, which takes longer."""
        shortcut = self.shortcut
        if len(path) + 2 > MAX_CORNERS:
            return path
        shortcut.arrays["path"][: len(path)] = path
        shortcut["count"] = len(path)
        shortcut["random_state"] = self._random_state()
        shortcut["proven"] = proven
        path_shortcut.shorten(shortcut.address, SHORTCUTS, PATIENCE)
        return shortcut.arrays["path"][: shortcut["count"]].copy()
