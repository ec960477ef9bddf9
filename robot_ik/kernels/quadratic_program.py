"""A small quadratic program: Goldfarb & Idnani, A numerically stable dual method, 1983.

    minimise ½ dᵀ H d − gᵀ d    with    lower ≤ d ≤ upper    and    A d ≥ b

It begins at the free minimum and adds the most violated constraint until no constraint is violated.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, kernel, outlined

# Largest violation of a constraint that counts as met.
_VIOLATION = 1e-10
# Below this share of its own slope a projected normal is zero: the constraint depends on the active
# ones.
_DEPENDENT = 1e-10
# A multiplier that changes by less than this stays.
_NO_CHANGE = 1e-14
_MAX_STEPS = 200

# With u unknowns, r rows, s = u + 1 constraints that may be active.
PROGRAM = Layout(
    "QuadraticProgram",
    row_count="int",  # rows of A in use
    active="int",  # active constraints
    hessian="table u u",  # H, symmetric positive definite
    gradient="floats u",  # g
    lower="floats u",
    upper="floats u",
    rows="table r u",  # A
    bounds="floats r",  # b
    solution="floats u",  # d
    inverse="table u u",
    factor="table s s",
    normals="table s u",  # of the active constraints
    chosen="ints s",  # index of each: a row; then lower, then upper bounds
    multiplier="floats s",
    normal="floats u",  # of the constraint that is added
    projected="floats u",
    direction="floats u",
    share="floats s",  # change of the multipliers
)
open_program = PROGRAM.open


@outlined
def solve_program(program):
    """Write the solution; return whether the constraints can be met. Overwrites all memory."""
    n = program.gradient.shape[0]
    if not invert(program.hessian, program.factor, program.projected, program.inverse):
        return False
    multiply(program.inverse, program.gradient, program.solution)
    program.active = 0
    for _ in range(_MAX_STEPS):
        constraint, bound = most_violated(program)
        if constraint < 0:
            return True
        write_normal(program, constraint)
        multiplier = 0.0
        added = False
        while not added:
            slope = project(program)
            partial_length = math.inf
            drop = -1
            for a in range(program.active):
                if program.share[a] > _NO_CHANGE:
                    length = program.multiplier[a] / program.share[a]
                    if length < partial_length:
                        partial_length = length
                        drop = a
            full_length = math.inf
            if slope > 0.0 and program.active < program.chosen.shape[0]:
                full_length = (bound - dot(program.normal, program.solution)) / slope
            length = min(partial_length, full_length)
            if length == math.inf:
                return False
            if full_length < math.inf:
                for i in range(n):
                    program.solution[i] += length * program.direction[i]
            for a in range(program.active):
                program.multiplier[a] -= length * program.share[a]
            multiplier += length
            if full_length <= partial_length:
                add_constraint(program, constraint, multiplier)
                added = True
            else:
                drop_constraint(program, drop)
    return False


@inlined
def dot(a, b):
    """Return a · b."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@inlined
def multiply(matrix, a, out):
    """Write matrix · a to ``out``."""
    for i in range(out.shape[0]):
        total = 0.0
        for k in range(out.shape[0]):
            total += matrix[i, k] * a[k]
        out[i] = total


@outlined
def invert(matrix, factor, column, inverse):
    """Write the inverse of a symmetric matrix; return whether it is positive definite."""
    n = matrix.shape[0]
    if not cholesky(matrix, factor, n):
        return False
    for c in range(n):
        for i in range(n):
            column[i] = 1.0 if i == c else 0.0
        solve_cholesky(factor, column, n)
        for i in range(n):
            inverse[i, c] = column[i]
    return True


@outlined
def cholesky(matrix, factor, n):
    """Write the lower factor of a symmetric matrix (its lower triangle) to ``factor``."""
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 0.0:
                factor[i, i] = math.sqrt(total)
            else:
                return False
    return True


@outlined
def solve_cholesky(factor, x, n):
    """Solve in place with the factor of ``cholesky``."""
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * x[k]
        x[i] = total / factor[i, i]


@outlined
def most_violated(program):
    """Return (constraint, its bound) of the largest violation, or -1."""
    n = program.gradient.shape[0]
    count = program.row_count
    worst = -_VIOLATION
    constraint = -1
    bound = 0.0
    for c in range(count):
        slack = -program.bounds[c]
        for k in range(n):
            slack += program.rows[c, k] * program.solution[k]
        if slack < worst:
            worst = slack
            constraint = c
            bound = program.bounds[c]
    for k in range(n):
        slack = program.solution[k] - program.lower[k]
        if slack < worst:
            worst = slack
            constraint = count + k
            bound = program.lower[k]
        slack = program.upper[k] - program.solution[k]
        if slack < worst:
            worst = slack
            constraint = count + n + k
            bound = -program.upper[k]
    return constraint, bound


@inlined
def write_normal(program, constraint):
    """Write the normal of a constraint."""
    n = program.gradient.shape[0]
    count = program.row_count
    for k in range(n):
        if constraint < count:
            program.normal[k] = program.rows[constraint, k]
        elif constraint < count + n:
            program.normal[k] = 1.0 if k == constraint - count else 0.0
        else:
            program.normal[k] = -1.0 if k == constraint - count - n else 0.0


@outlined
def project(program):
    """Write the direction that leaves the active constraints as they are; return its slope.

    The slope is 0 if the new constraint depends on the active ones. Writes program.share too, the
    change of their multipliers.
    """
    n = program.gradient.shape[0]
    active = program.active
    multiply(program.inverse, program.normal, program.projected)
    free_slope = dot(program.projected, program.normal)
    if active > 0:
        for a in range(active):
            total = 0.0
            for k in range(n):
                total += program.normals[a, k] * program.projected[k]
            program.share[a] = total
            for i in range(n):
                total = 0.0
                for k in range(n):
                    total += program.inverse[i, k] * program.normals[a, k]
                program.direction[i] = total
            for c in range(a + 1):
                total = 0.0
                for k in range(n):
                    total += program.normals[c, k] * program.direction[k]
                program.factor[a, c] = total
        # In place: the lower triangle is read before it is overwritten.
        for a in range(active):
            for c in range(a + 1):
                total = program.factor[a, c]
                for k in range(c):
                    total -= program.factor[a, k] * program.factor[c, k]
                if a > c:
                    program.factor[a, c] = total / program.factor[c, c]
                else:
                    program.factor[a, a] = math.sqrt(max(total, 1e-30))
        solve_cholesky(program.factor, program.share, active)
    for k in range(n):
        total = program.normal[k]
        for a in range(active):
            total -= program.normals[a, k] * program.share[a]
        program.projected[k] = total
    multiply(program.inverse, program.projected, program.direction)
    slope = dot(program.direction, program.normal)
    return slope if slope > _DEPENDENT * free_slope else 0.0


@inlined
def add_constraint(program, constraint, multiplier):
    """Make a constraint active."""
    a = program.active
    for k in range(program.gradient.shape[0]):
        program.normals[a, k] = program.normal[k]
    program.multiplier[a] = multiplier
    program.chosen[a] = constraint
    program.active = a + 1


@inlined
def drop_constraint(program, drop):
    """Make an active constraint inactive."""
    for a in range(drop, program.active - 1):
        program.multiplier[a] = program.multiplier[a + 1]
        program.chosen[a] = program.chosen[a + 1]
        for k in range(program.gradient.shape[0]):
            program.normals[a, k] = program.normals[a + 1, k]
    program.active -= 1


@kernel
def solve(address):
    """Run ``solve_program``."""
    return solve_program(open_program(address))
