"""Where, on the circle of swivel angles, a limb's joints meet their limits: made once for a problem.

The shoulder's rotation is S(φ) = R(n, φ) S₀, so that every number yᵀ S(φ) x is a + b cos φ + c sin φ, and
so is yᵀ W(φ) x of the wrist's.  Each limit of a joint is such a number that takes one value d (after
Tolani, Goswami & Badler, Graphical Models 62, 2000, section 4): with S = R₁ R₂ R₃ about axes h₁, h₂, h₃

    q₁ = L:  (R₁(L) h₂)ᵀ S h₃ = h₂ᵀ h₃        q₃ = L:  h₁ᵀ S (R₃(-L) h₂) = h₁ᵀ h₂
    q₂ = L:  h₁ᵀ S h₃ = h₁ᵀ R₂(L) h₃          ball:    tr S = 1 + 2 cos L
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import quat_to_matrix, rotation_exp
from robot_ik.solvers.analytic.geometry import BALL_JOINT, HINGES, Family, Form

Array = NDArray[np.float64]

# Columns of an edge: which rotation (shoulder, wrist, then their traces), y (3), x (3), d.
COLUMNS = 8


def middle_turns(form: Form) -> Array:
    """(2, 3) for shoulder and wrist of hinges: h₁ᵀ R₂(q) h₃ = constant + amplitude · cos(q - middle)."""
    rows = np.zeros((2, 3))
    if form.family < Family.LIMB:
        return rows
    for g in range(2):
        if form.groups[g, 0] == HINGES:
            a, b, c = form.axes[4 * g : 4 * g + 3, :3]
            constant = float(a @ b) * float(b @ c)
            even, odd = float(a @ c) - constant, float(a @ np.cross(b, c))
            rows[g] = constant, np.hypot(even, odd), np.arctan2(odd, even)
    return rows


def limit_edges(form: Form, lower: Array, upper: Array) -> Array:
    """(m, 8) all limits ``lower``, ``upper`` (by column of the form) as equations of the swivel angle."""
    rows: list[Array] = []
    turns = middle_turns(form)
    for g in range(2 if form.family >= Family.LIMB else 0):
        first = int(form.groups[g, 1])
        if form.groups[g, 0] == BALL_JOINT and upper[first] < np.pi:
            rows.append(np.array([2 + g, *np.zeros(6), 1.0 + 2.0 * np.cos(upper[first])]))
        if form.groups[g, 0] != HINGES:
            continue
        a, b, c = form.axes[4 * g : 4 * g + 3, :3]
        constant, amplitude, _ = turns[g]
        rows += [np.array([g, *a, *c, constant + sign * amplitude]) for sign in (-1.0, 1.0)]
        for j in range(3):
            if upper[first + j] - lower[first + j] >= 2.0 * np.pi:
                continue
            for limit in (lower[first + j], upper[first + j]):
                rows.append(_edge(g, j, a, b, c, float(limit)))
    return np.array(rows).reshape(-1, COLUMNS)


def _edge(g: int, joint: int, a: Array, b: Array, c: Array, limit: float) -> Array:
    turned = quat_to_matrix(rotation_exp((a, b, c)[joint] * limit))
    if joint == 0:
        return np.array([g, *(turned @ b), *c, b @ c])
    if joint == 1:
        return np.array([g, *a, *c, a @ turned @ c])
    return np.array([g, *a, *(turned.T @ b), a @ b])
