"""Arms with five joints: the position nearest to a target that is out of reach.

With pan and turn fixed, the arm is three links in a plane. At the smallest distance each joint is
at a limit, or rotates the rest of the arm towards or away from the target. So it suffices to try
every choice of joints at a limit, with the links between free joints rigid and aligned. The pan
follows in closed form; plane and pan are solved in turn. The turn is sampled and refined.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.solvers.analytic.five_joint_pitch import (
    is_inside,
    length,
    read_point,
    shoulder_of,
    tool_at_turn,
    unit,
    wrap,
)

# Turns that are tried, and starts of the pan.
_TURNS = 33
_PANS = 4
# Largest number of alternations of pan and plane, in the search and in the last polish. The
# smallest improvement, m, for another alternation.
_ALTERNATIONS = 40
_LAST_ALTERNATIONS = 1000
_NO_IMPROVEMENT = 1e-13
# Step of the turn at which the refinement ends, rad. Largest number of steps.
_LAST_TURN_STEP = 1e-9
_MAX_TURN_STEPS = 120
# First and last step of the turn in a loop, rad. Factor on the step after no improvement.
_LOCAL_TURN_STEP = 0.1
_LAST_LOCAL_STEP = 1e-4
_STEP_FACTOR = 0.6

NEAREST = Layout(
    "FiveJointNearest",
    links="table 3 2",  # links at zero joint angles
    rigid="table 3 2",  # links between free joints, as one piece each
    q="floats 5",  # the best joint angles, counted about the axes of the basis
    trial="floats 5",
    plane="floats 3",  # pitch joints that are tried
)


@inlined
def write_point(table, row, point):
    """Write a point of the arm plane to the first two numbers of a row."""
    table[row, 0] = point.real
    table[row, 1] = point.imag


@inlined
def limit_of(arm, joint, choice):
    """Return the lower limit of a pitch joint for choice 1, the upper limit for choice 2."""
    return arm.lower[1 + joint] if choice == 1 else arm.upper[1 + joint]


@inlined
def choice_of(choices, joint):
    """Return the state of one of three joints: 0 free, 1 at its lower, 2 at its upper limit."""
    if joint == 0:
        return choices // 9
    return (choices // 3) % 3 if joint == 1 else choices % 3


@inlined
def write_rigid_pieces(arm, nearest, choices):
    """Write the pieces between free joints to nearest.rigid; return their number and the base.

    The base is the end of the links that do not move.
    """
    base = complex(0.0, 0.0)
    rotation = complex(1.0, 0.0)
    count = 0
    for joint in range(3):
        choice = choice_of(choices, joint)
        link = read_point(nearest.links, joint)
        if choice == 0:
            write_point(nearest.rigid, count, link)
            count += 1
            rotation = complex(1.0, 0.0)
            continue
        rotation *= unit(limit_of(arm, joint, choice))
        if count == 0:
            base += rotation * link
        else:
            write_point(
                nearest.rigid, count - 1, read_point(nearest.rigid, count - 1) + rotation * link
            )
    return count, base


@inlined
def directions(nearest, count, goal, variant):
    """Return the directions of up to three free pieces, and whether this variant exists.

    Each piece points to the goal or away from it. Two pieces may also reach the goal exactly.
    """
    direction = math.atan2(goal.imag, goal.real)
    if count == 2 and variant >= 4:
        first = length(read_point(nearest.rigid, 0))
        second = length(read_point(nearest.rigid, 1))
        distance = length(goal)
        if not abs(first - second) < distance < first + second or first == 0.0:
            return direction, direction, direction, False
        squares = first * first + distance * distance - second * second
        inner = math.acos(min(1.0, max(-1.0, squares / (2.0 * first * distance))))
        turned = direction + inner if variant == 4 else direction - inner
        rest = goal - first * unit(turned)
        return turned, math.atan2(rest.imag, rest.real), 0.0, True
    return (
        direction + math.pi * (variant & 1),
        direction + math.pi * ((variant >> 1) & 1),
        direction + math.pi * ((variant >> 2) & 1),
        True,
    )


@inlined
def variants_of(count):
    """Return the number of variants of ``directions``."""
    if count == 2:
        return 6
    return 1 << count


@outlined
def plane_distance(arm, nearest, choices, point):
    """Return the distance from ``point`` for the directions in nearest.plane; inf outside limits.

    Overwrites nearest.plane: directions of the free pieces become joint angles.
    """
    first = nearest.plane[0]
    second = nearest.plane[1]
    third = nearest.plane[2]
    total = 0.0
    reached = complex(0.0, 0.0)
    used = 0
    for joint in range(3):
        choice = choice_of(choices, joint)
        lower = arm.lower[1 + joint]
        upper = arm.upper[1 + joint]
        if choice == 0:
            piece = read_point(nearest.rigid, used)
            direction = first if used == 0 else second if used == 1 else third
            used += 1
            heading = direction - math.atan2(piece.imag, piece.real)
            middle = 0.5 * (lower + upper)
            angle = middle + wrap(heading - total - middle)
            if not is_inside(angle, lower, upper):
                return math.inf
        else:
            angle = limit_of(arm, joint, choice)
        nearest.plane[joint] = angle
        total += angle
        reached += read_point(nearest.links, joint) * unit(total)
    return length(point - reached)


@outlined
def solve_plane(arm, nearest, point, tool):
    """Return the smallest distance from ``point`` to the tool point; write nearest.trial[1:4]."""
    write_point(nearest.links, 0, arm.upper_length * unit(arm.upper_angle))
    write_point(nearest.links, 1, arm.fore_length * unit(arm.fore_angle))
    write_point(nearest.links, 2, tool * unit(arm.pitch_zero))
    best = math.inf
    for choices in range(27):
        pieces, base = write_rigid_pieces(arm, nearest, choices)
        goal = point - base
        for variant in range(variants_of(pieces)):
            first, second, third, exists = directions(nearest, pieces, goal, variant)
            if not exists:
                continue
            nearest.plane[0] = first
            nearest.plane[1] = second
            nearest.plane[2] = third
            distance = plane_distance(arm, nearest, choices, point)
            if distance < best:
                best = distance
                for k in range(3):
                    nearest.trial[1 + k] = nearest.plane[k]
    return best


@outlined
def planar_tool(arm, q, tool):
    """Return the tool point in the arm plane, seen from the pan joint."""
    heading = q[1]
    point = shoulder_of(arm) + arm.upper_length * unit(heading + arm.upper_angle)
    heading += q[2]
    point += arm.fore_length * unit(heading + arm.fore_angle)
    return point + tool * unit(heading + q[3] + arm.pitch_zero)


@outlined
def tool_point(arm, q):
    """Return the tool point in the frame of the arm, for angles about the axes of the basis."""
    turn = q[4] + arm.turn_zero
    point = planar_tool(arm, q, tool_at_turn(arm, turn))
    across = arm.side + arm.radius * math.sin(turn)
    c = math.cos(q[0])
    s = math.sin(q[0])
    return c * point.real - s * across, s * point.real + c * across, -point.imag


@inlined
def clipped_pan(arm, pan):
    """Return the pan inside its limits."""
    middle = 0.5 * (arm.lower[0] + arm.upper[0])
    return min(arm.upper[0], max(arm.lower[0], middle + wrap(pan - middle)))


@outlined
def solve_turn(arm, target, nearest, turn, pan, alternations):
    """Return the smallest distance at a fixed turn, from a pan angle on; write nearest.trial."""
    across = arm.side + arm.radius * math.sin(turn)
    tool = tool_at_turn(arm, turn)
    last = math.inf
    nearest.trial[4] = turn - arm.turn_zero
    for _ in range(alternations):
        lateral = target.range * math.sin(target.azimuth - pan) - across
        forward = target.range * math.cos(target.azimuth - pan)
        point = complex(forward, -target.height) - shoulder_of(arm)
        in_plane = solve_plane(arm, nearest, point, tool)
        distance = math.sqrt(in_plane * in_plane + lateral * lateral)
        nearest.trial[0] = pan
        if last - distance < _NO_IMPROVEMENT:
            return distance
        last = distance
        reached = planar_tool(arm, nearest.trial, tool)
        pan = clipped_pan(arm, target.azimuth - math.atan2(across, reached.real))
    return last


@inlined
def keep_trial(nearest):
    """Make the trial the best joint angles."""
    for k in range(5):
        nearest.q[k] = nearest.trial[k]


@outlined
def solve_nearest(arm, target, nearest):
    """Return the smallest distance found from the tool point to the target; write nearest.q."""
    best = math.inf
    lower = arm.lower[4] + arm.turn_zero
    width = (arm.upper[4] - arm.lower[4]) / (_TURNS - 1)
    best_turn = lower
    for k in range(_PANS):
        if k == 0:
            pan = clipped_pan(arm, target.azimuth)
        elif k == 1:
            pan = clipped_pan(arm, target.azimuth + math.pi)
        else:
            pan = arm.lower[0] if k == 2 else arm.upper[0]
        for j in range(_TURNS):
            distance = solve_turn(arm, target, nearest, lower + j * width, pan, _ALTERNATIONS)
            if distance < best:
                best = distance
                best_turn = lower + j * width
                keep_trial(nearest)
    best, best_turn = refine_turn(arm, target, nearest, best, best_turn, width, _LAST_TURN_STEP)
    distance = solve_turn(arm, target, nearest, best_turn, nearest.q[0], _LAST_ALTERNATIONS)
    if distance < best:
        best = distance
        keep_trial(nearest)
    return best


@outlined
def solve_nearest_locally(arm, target, nearest, start):
    """Return the smallest distance near joint angles ``start``; write nearest.q.

    It takes about a twentieth of the time of ``solve_nearest``, for loops.
    """
    turn = start[4] + arm.turn_zero
    best = solve_turn(arm, target, nearest, turn, start[0], _ALTERNATIONS)
    keep_trial(nearest)
    best, _ = refine_turn(arm, target, nearest, best, turn, _LOCAL_TURN_STEP, _LAST_LOCAL_STEP)
    return best


@outlined
def refine_turn(arm, target, nearest, best, best_turn, step, last_step):
    """Improve nearest.q by shrinking steps of the turn; return the distance and the turn."""
    lower = arm.lower[4] + arm.turn_zero
    upper = arm.upper[4] + arm.turn_zero
    step *= _STEP_FACTOR
    for _ in range(_MAX_TURN_STEPS):
        if step < last_step:
            break
        before = best
        for sign in (-1.0, 1.0):
            turn = min(upper, max(lower, best_turn + sign * step))
            distance = solve_turn(arm, target, nearest, turn, nearest.q[0], _ALTERNATIONS)
            if distance < best:
                best = distance
                best_turn = turn
                keep_trial(nearest)
        if not best < before - _NO_IMPROVEMENT:
            step *= _STEP_FACTOR
    return best, best_turn
