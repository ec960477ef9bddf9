"""Arms with five joints: branch and bound over the one parameter without a closed form.

The parameter is the turn, or the bearing for a target nearer to the pan axis than the tool point is
to the roll axis. ``five_joint_pitch.best_pitch`` gives the smallest angle for each parameter.
``box_bound`` gives a lower bound of the angle for an interval of parameters (a box). Boxes whose
bound is not smaller than the best known angle by ``GAP`` are discarded; others are halved.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.solvers.analytic.five_joint_pitch import (
    LIMIT_SLACK,
    ON_BOUNDARY,
    SINE_SLACK,
    allows_pitch,
    angle_from,
    angle_of_objective,
    best_pitch,
    coupled,
    elbow_bend,
    is_inside,
    length,
    nearest_edge,
    panned,
    pitch_terms,
    point_at_bearing,
    read_point,
    tool_at_turn,
    unit,
    wrap,
    write_edges,
)

# rad. The search ends when the lower bound is this near to the best angle (0.009 degrees).
GAP = math.radians(0.009)
# Largest number of boxes of one branch. About 1 of 6000 random targets needs more. The bound is
# valid then too, but the gap is larger.
_MAX_BOXES = 4000
# Largest number of boxes that wait at one time.
_MAX_OPEN_BOXES = 2048
# Width of a box that is not divided further: rounding of the sine equation.
_SMALLEST_BOX = 1e-13
# Parameters that are tried on each piece before the search.
_SAMPLES = 4
# rad per metre. Width of a box at which the proof of ``is_out_of_reach`` ends without a result.
_SMALLEST_PROOF_BOX = 0.1
# Golden-section steps of the polish. They shrink the last box by 4e-6.
_POLISH_STEPS = 26
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# m. Tool points and targets nearer to an axis than this lie on it.
ON_AXIS = 1e-9
# rad. Angles are searched up to this beyond a pan or roll limit, then clipped. A target that needs
# the pan joint exactly at its limit is met at one roll angle only, which a search does not find.
_END_SLACK = 1e-7
# rad. Excesses over a joint limit that differ by less are equal.
_SAME_EXCESS = 1e-6
# rad. A branch whose search ended this much above the best known angle is not polished.
_WORTH_POLISHING = math.radians(0.5)
# rad. Half width of the parameters that ``track`` searches around the start.
_TRACK_WINDOW = 0.15
# rad. An optimum nearer than this to an end of the window is outside.
_AT_WINDOW_END = 1e-4
# rad. A joint that would move farther in one step of ``track`` jumps.
_LONGEST_STEP = 1.0
# Pieces of one branch, cuts of the parameter, and branches: two of the pan, up to four of the
# elbow.
_PIECES = 64
_BRANCHES = 8

_FULL_TURN = 2.0 * math.pi
_QUARTER_TURN = 0.5 * math.pi

# How the search of a branch ended.
SEARCHED, NO_CONFIGURATION, BOX_LIMIT = range(3)
# Columns of ``SEARCH.results``.
OUTCOME, ANGLE, BOUND = range(3)
# Columns of ``SEARCH.best``: the smallest angle so far, its parameter and pitch, and the width of
# the interval around it that was not searched.
_ANGLE, _PARAMETER, _PITCH, _WIDTH = range(4)

SEARCH = Layout(
    "FiveJointSearch",
    known="float",  # smallest angle of any branch so far; larger angles are discarded
    track_branch="int",
    branches="int",  # number of branches
    boxes="table 2048 3",  # first and last parameter, lower bound
    cuts="floats 64",
    corners="table 16 4",  # constant, cosine and sine term of the objective, and its maximum
    order="int_table 8 2",  # of each branch: backwards 0 or 1, row of ``ARM.sheets``
    pieces="table 8 128",  # of each branch: intervals of the parameter, first and last in turn
    counts="ints 8",  # of each branch: number of pieces
    best="table 8 4",
    results="table 8 3",
    qs="table 8 5",  # of each branch: joint angles, counted about the axes of the basis
    start="floats 5",  # joint angles of the start, counted in this way
)


@inlined
def take_branch(arm, target, search, branch):
    """Write one branch to ``target``, which is then searched."""
    sheet = search.order[branch, 1]
    target.back = search.order[branch, 0] == 1
    target.sign = arm.sheets[sheet, 0]
    target.shortest = arm.sheets[sheet, 1]
    target.longest = arm.sheets[sheet, 2]


# Lower bound of a box


@inlined
def hull(angle, half):
    """Return four points whose hull holds the arc of (cos, sin) within ``half`` of an angle.

    Two are the ends of the arc. Two lie on the tangent in its middle.
    """
    c = math.cos(angle)
    s = math.sin(angle)
    end_c = math.cos(half)
    end_s = math.sin(half)
    tangent = math.tan(0.5 * half)
    return (
        (end_c * c - end_s * s, end_c * s + end_s * c),
        (end_c * c + end_s * s, end_c * s - end_s * c),
        (c - tangent * s, s + tangent * c),
        (c + tangent * s, s - tangent * c),
    )


@inlined
def cosine_spread(first, middle, last):
    """Return the largest change of the cosine from ``middle`` to any angle between the others."""
    centre = math.cos(middle)
    spread = max(abs(math.cos(first) - centre), abs(math.cos(last) - centre))
    if math.sin(first) * math.sin(last) < 0.0:
        spread = max(spread, 1.0 - abs(centre))
    return spread


@inlined
def write_corners(target, search, pan, pan_half, roll, roll_half):
    """Write the objective at the corners of a box to search.corners; return their number."""
    corners = search.corners
    count = 0
    rolls = hull(roll, roll_half)
    for c, s in hull(pan, pan_half):
        matrix = panned(target.matrix, c, s)
        for roll_c, roll_s in rolls:
            constant, cosine, sine = pitch_terms(matrix, roll_c, roll_s)
            corners[count, 0] = constant
            corners[count, 1] = cosine
            corners[count, 2] = sine
            corners[count, 3] = constant + math.sqrt(cosine * cosine + sine * sine)
            count += 1
        if pan_half == 0.0:
            break
    return count


@inlined
def highest_corner(corners, count):
    """Return the corner with the largest objective."""
    highest = 0
    for k in range(1, count):
        if corners[k, 3] > corners[highest, 3]:
            highest = k
    return highest


@inlined
def coupled_range(arm, target, first, last, slack):
    """Return the range of the coupled angle for parameters in [first, last].

    The range is empty, with its lower end above its upper end, if the sine is outside [-1, 1].
    ``slack`` is the allowed distance of the tool point from the target, m.
    """
    if target.by_turn:
        scale = 1.0 / target.range
        first_sine = (arm.side + arm.radius * math.sin(first)) * scale
        last_sine = (arm.side + arm.radius * math.sin(last)) * scale
    else:
        scale = 1.0 / arm.radius
        first_sine = (target.range * math.sin(first) - arm.side) * scale
        last_sine = (target.range * math.sin(last) - arm.side) * scale
    lower = min(first_sine, last_sine) - slack * scale
    upper = max(first_sine, last_sine) + slack * scale
    if lower > 1.0 + SINE_SLACK or upper < -1.0 - SINE_SLACK:
        return 1.0, -1.0
    start = math.asin(max(-1.0, min(1.0, lower)))
    end = math.asin(max(-1.0, min(1.0, upper)))
    if target.back:
        return math.pi - end, math.pi - start
    return start, end


@outlined
def box_bound(arm, target, search, first, last, enough, position_slack):
    """Return a lower bound of the angle for parameters in [first, last]; inf if none is possible.

    Bearing and turn vary over arcs. Each arc lies in the hull of four points, and the objective is
    linear in each of them. So it is largest at one of 16 corners, for every pitch. For each
    corner the best pitch is the pitch nearest to the optimum of the corner that some parameter in
    the box may allow. The limits of the pitch joints are left out if the bound without them is at
    least ``enough``.

    The bound holds for every tool point within ``position_slack`` metres of the target.
    """
    start, end = coupled_range(arm, target, first, last, position_slack)
    if start > end:
        return math.inf
    if target.by_turn:
        bearing = 0.5 * (start + end)
        bearing_half = 0.5 * (end - start)
        turn = 0.5 * (first + last)
        turn_half = 0.5 * (last - first)
    else:
        bearing = 0.5 * (first + last)
        bearing_half = 0.5 * (last - first)
        turn = 0.5 * (start + end)
        turn_half = 0.5 * (end - start)
    pan = target.azimuth - bearing
    if position_slack > 0.0:
        middle = 0.5 * (arm.lower[0] + arm.upper[0])
        half = 0.5 * (arm.upper[0] - arm.lower[0]) + bearing_half + LIMIT_SLACK
        if half < math.pi and abs(wrap(pan - middle)) > half:
            return math.inf
        middle = 0.5 * (arm.lower[4] + arm.upper[4]) + arm.turn_zero
        half = 0.5 * (arm.upper[4] - arm.lower[4]) + turn_half + LIMIT_SLACK
        if half < math.pi and abs(wrap(turn - middle)) > half:
            return math.inf
    corners = search.corners
    count = write_corners(target, search, pan, bearing_half, turn - arm.turn_zero, turn_half)
    corner = highest_corner(corners, count)
    angle = angle_of_objective(corners[corner, 3], target.kind)
    if angle >= enough:
        return angle

    point = point_at_bearing(arm, target, bearing)
    tool = tool_at_turn(arm, turn)
    slack = target.range * cosine_spread(bearing - bearing_half, bearing, bearing + bearing_half)
    slack += arm.radius * cosine_spread(turn - turn_half, turn, turn + turn_half)
    slack += position_slack
    edges = -1
    best = -math.inf
    for _ in range(count):
        corner = highest_corner(corners, count)
        free = corners[corner, 3]
        if free <= best:
            break
        corners[corner, 3] = -math.inf
        wanted = math.atan2(corners[corner, 2], corners[corner, 1])
        objective = free
        if not allows_pitch(arm, target, point, tool, wanted, slack + ON_BOUNDARY):
            if edges < 0:
                edges = write_edges(arm, target, point, tool, slack)
            distance, _, edges = nearest_edge(
                arm, target, point, tool, wanted, slack + ON_BOUNDARY, edges
            )
            if distance == math.inf:
                return math.inf  # no pitch is allowed in the box
            constant = corners[corner, 0]
            objective = constant + (free - constant) * math.cos(distance)
        best = max(best, objective)
    return angle_of_objective(best, target.kind)


# Search


@inlined
def keep_better(best, branch, angle, parameter, pitch, width):
    """Write a configuration to ``best`` if its angle is smaller."""
    if angle < best[branch, _ANGLE]:
        best[branch, _ANGLE] = angle
        best[branch, _PARAMETER] = parameter
        best[branch, _PITCH] = pitch
        if width > 0.0:
            best[branch, _WIDTH] = width


@inlined
def push_box(boxes, size, first, last, bound):
    """Append a box; return the new number of boxes."""
    boxes[size, 0] = first
    boxes[size, 1] = last
    boxes[size, 2] = bound
    return size + 1


@outlined
def search_branch(arm, target, search, branch):
    """Search one branch; improve its row of search.best and search.known.

    Returns how the search ended, and a lower bound of the angle over the branch.
    """
    boxes = search.boxes
    best = search.best
    size = 0
    bound = math.inf
    enough = min(best[branch, _ANGLE], search.known) - GAP
    for k in range(search.counts[branch]):
        first = search.pieces[branch, 2 * k]
        last = search.pieces[branch, 2 * k + 1]
        lower = box_bound(arm, target, search, first, last, enough, 0.0)
        size = push_box(boxes, size, first, last, lower)
    evaluated = size
    while size > 0:
        k = 0
        for j in range(1, size):
            if boxes[j, 2] < boxes[k, 2]:
                k = j
        first = boxes[k, 0]
        last = boxes[k, 1]
        lower = boxes[k, 2]
        if lower >= min(best[branch, _ANGLE], search.known) - GAP:
            return SEARCHED, min(bound, lower)
        size -= 1
        for i in range(3):
            boxes[k, i] = boxes[size, i]
        middle = 0.5 * (first + last)
        angle, pitch = best_pitch(arm, target, middle)
        keep_better(best, branch, angle, middle, pitch, last - first)
        if last - first < _SMALLEST_BOX:
            bound = min(bound, lower)
            continue
        if evaluated + 2 > _MAX_BOXES or size + 2 > _MAX_OPEN_BOXES:
            return BOX_LIMIT, min(bound, lower)
        enough = min(best[branch, _ANGLE], search.known) - GAP
        for half in range(2):
            start = first if half == 0 else middle
            end = middle if half == 0 else last
            part = max(lower, box_bound(arm, target, search, start, end, enough, 0.0))
            evaluated += 1
            if part >= enough:
                bound = min(bound, part)
            else:
                size = push_box(boxes, size, start, end, part)
    return SEARCHED, bound


@outlined
def sample_branch(arm, target, search, branch):
    """Try some parameters of each piece; improve the row of search.best."""
    for k in range(search.counts[branch]):
        first = search.pieces[branch, 2 * k]
        width = (search.pieces[branch, 2 * k + 1] - first) / _SAMPLES
        for j in range(_SAMPLES):
            parameter = first + (j + 0.5) * width
            angle, pitch = best_pitch(arm, target, parameter)
            keep_better(search.best, branch, angle, parameter, pitch, width)


@inlined
def interval_around_best(search, branch):
    """Return the interval around the best parameter that the polish searches.

    It consists of the piece with the best parameter and the pieces next to it.
    """
    pieces = search.pieces
    parameter = search.best[branch, _PARAMETER]
    width = search.best[branch, _WIDTH]
    first = parameter - width
    last = parameter + width
    count = search.counts[branch]
    for k in range(count):
        lower = pieces[branch, 2 * k]
        upper = pieces[branch, 2 * k + 1]
        if not lower <= parameter <= upper:
            continue
        begin = lower
        end = upper
        for j in range(count):
            if abs(pieces[branch, 2 * j + 1] - lower) < 1e-14:
                begin = pieces[branch, 2 * j]
            if abs(pieces[branch, 2 * j] - upper) < 1e-14:
                end = pieces[branch, 2 * j + 1]
        return max(first, begin), min(last, end)
    return first, last


@outlined
def polish(arm, target, search, branch, steps):
    """Improve the row of search.best by a golden-section search around its parameter."""
    best = search.best
    first, last = interval_around_best(search, branch)
    for edge in (first, last):
        angle, pitch = best_pitch(arm, target, edge)
        keep_better(best, branch, angle, edge, pitch, 0.0)
    left = last - _GOLDEN * (last - first)
    right = first + _GOLDEN * (last - first)
    left_angle, left_pitch = best_pitch(arm, target, left)
    right_angle, right_pitch = best_pitch(arm, target, right)
    for _ in range(steps):
        keep_better(best, branch, left_angle, left, left_pitch, 0.0)
        keep_better(best, branch, right_angle, right, right_pitch, 0.0)
        parameter = best[branch, _PARAMETER]
        left_is_nearer = abs(left - parameter) < abs(right - parameter)
        if left_angle < right_angle or (left_angle == right_angle and left_is_nearer):
            last = right
            right = left
            right_angle = left_angle
            right_pitch = left_pitch
            left = last - _GOLDEN * (last - first)
            left_angle, left_pitch = best_pitch(arm, target, left)
        else:
            first = left
            left = right
            left_angle = right_angle
            left_pitch = right_pitch
            right = first + _GOLDEN * (last - first)
            right_angle, right_pitch = best_pitch(arm, target, right)


# Pieces of the parameter


@inlined
def sort(values, count):
    """Sort the first ``count`` values in place."""
    for k in range(1, count):
        value = values[k]
        j = k
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value


@inlined
def add_sine_roots(cuts, count, sine, lower, upper):
    """Append the parameters in [lower, upper] with this sine to ``cuts``; return their number."""
    if abs(sine) < 1.0:
        angle = math.asin(sine)
        for root in (angle, math.pi - angle):
            root += _FULL_TURN * math.ceil((lower - root) / _FULL_TURN)
            while root < upper and count < _PIECES:
                cuts[count] = root
                count += 1
                root += _FULL_TURN
    return count


@outlined
def write_pieces(arm, target, search, branch):
    """Write the intervals of the parameter inside the pan and roll limits to search.pieces.

    They are cut at multiples of π/2, so that sine and cosine are monotone on each.
    """
    cuts = search.cuts
    pan_lower = arm.lower[0] - _END_SLACK
    pan_upper = arm.upper[0] + _END_SLACK
    turn_lower = arm.lower[4] + arm.turn_zero - _END_SLACK
    turn_upper = arm.upper[4] + arm.turn_zero + _END_SLACK
    if target.by_turn:
        lower = turn_lower
        upper = turn_upper
    else:
        lower = target.azimuth - pan_upper
        upper = target.azimuth - pan_lower
    if upper - lower > _FULL_TURN:
        lower = -math.pi
        upper = math.pi
    cuts[0] = lower
    cuts[1] = upper
    count = 2
    quarter = math.ceil(lower / _QUARTER_TURN) * _QUARTER_TURN
    while quarter < upper:
        cuts[count] = quarter
        count += 1
        quarter += _QUARTER_TURN
    if target.by_turn and arm.radius > 0.0:
        scale = 1.0 / arm.radius
        for sine in (
            -1.0,
            1.0,
            math.sin(target.azimuth - pan_lower),
            math.sin(target.azimuth - pan_upper),
        ):
            height = (target.range * sine - arm.side) * scale
            count = add_sine_roots(cuts, count, height, lower, upper)
    if not target.by_turn and target.range > 0.0:
        scale = 1.0 / target.range
        for sine in (-1.0, 1.0, math.sin(turn_lower), math.sin(turn_upper)):
            height = (arm.side + arm.radius * sine) * scale
            count = add_sine_roots(cuts, count, height, lower, upper)
    sort(cuts, count)
    written = 0
    for k in range(count - 1):
        if cuts[k + 1] - cuts[k] < 1e-15:
            continue
        bearing, turn, excess = coupled(arm, target, 0.5 * (cuts[k] + cuts[k + 1]))
        if excess > 0.0 or not is_inside(target.azimuth - bearing, pan_lower, pan_upper):
            continue
        if is_inside(turn, turn_lower, turn_upper):
            search.pieces[branch, 2 * written] = cuts[k]
            search.pieces[branch, 2 * written + 1] = cuts[k + 1]
            written += 1
    search.counts[branch] = written


# Joint angles


@outlined
def write_joint_angles(arm, target, search, branch):
    """Write the joint angles of the best configuration of a branch to search.qs.

    A joint slightly beyond its limit is set to the limit, and the other pitch joints close the
    chain. The tool point then moves by the excess in metres, at most ON_BOUNDARY, not by its square
    root.
    """
    pitch = search.best[branch, _PITCH]
    bearing, turn, _ = coupled(arm, target, search.best[branch, _PARAMETER])
    point = point_at_bearing(arm, target, bearing)
    heading = unit(pitch)
    wrist = point - heading * tool_at_turn(arm, turn)
    distance = min(target.longest, max(target.shortest, length(wrist)))
    bend = elbow_bend(arm, target.sign, distance)
    upper_direction = angle_from(arm.upper_length + arm.fore_length * bend, wrist)
    fore_direction = upper_direction + math.atan2(bend.imag, bend.real)
    lift = upper_direction - arm.upper_angle
    if not is_inside(lift, arm.lower[1], arm.upper[1]):
        lower_is_nearer = abs(wrap(lift - arm.lower[1])) < abs(wrap(lift - arm.upper[1]))
        lift = arm.lower[1] if lower_is_nearer else arm.upper[1]
        rest = wrist - read_point(arm.ends, 0 if lower_is_nearer else 1)
        fore_direction = math.atan2(rest.imag, rest.real)
    flex = pitch - arm.pitch_zero - (fore_direction - arm.fore_angle)
    if not is_inside(flex, arm.lower[3], arm.upper[3]):
        lower_is_nearer = abs(wrap(flex - arm.lower[3])) < abs(wrap(flex - arm.upper[3]))
        flex = arm.lower[3] if lower_is_nearer else arm.upper[3]
        fore = heading * read_point(arm.ends, 2 if lower_is_nearer else 3)
        fore_direction = math.atan2(fore.imag, fore.real)
        rest = wrist - fore
        lift = math.atan2(rest.imag, rest.real) - arm.upper_angle
    qs = search.qs
    qs[branch, 0] = target.azimuth - bearing
    qs[branch, 1] = lift
    qs[branch, 2] = fore_direction - arm.fore_angle - lift
    qs[branch, 3] = flex
    qs[branch, 4] = turn - arm.turn_zero
    for k in range(5):
        qs[branch, k] = brought_inside(qs[branch, k], search.start[k], arm.lower[k], arm.upper[k])


@inlined
def brought_inside(angle, start, lower, upper):
    """Return the angle, moved by full turns into its limits, nearest to ``start``, and clipped.

    An angle slightly beyond a limit is clipped to that limit, not moved to the other limit.
    """
    nearest = start + wrap(angle - start)
    inside = nearest
    smallest = math.inf
    for turns in (0.0, -1.0, 1.0, -2.0, 2.0):
        image = nearest + _FULL_TURN * turns
        excess = max(0.0, max(lower - image, image - upper))
        if excess < smallest - _SAME_EXCESS:
            smallest = excess
            inside = image
    return min(upper, max(lower, inside))


# All branches


@outlined
def order_branches(arm, target, search):
    """Write search.order: all branches, that of the start first."""
    start = search.start
    if target.by_turn:
        back = math.cos(target.azimuth - start[0]) < 0.0
    else:
        back = math.cos(start[4] + arm.turn_zero) < 0.0
    bend = math.sin(arm.fore_angle + start[2] - arm.upper_angle)
    sheets = arm.sheets.shape[0]
    count = 0
    for place in range(4):
        for sheet in range(sheets):
            same_elbow = arm.sheets[sheet, 0] * bend >= 0.0
            if same_elbow != (place % 2 == 0):
                continue
            search.order[count, 0] = 1 if back != (place >= 2) else 0
            search.order[count, 1] = sheet
            count += 1
    search.branches = count


@outlined
def solve_branches(arm, target, search, every):
    """Search the branches; write search.results and search.qs.

    With ``every`` each branch gets its own optimum. Else a branch is searched only for angles
    smaller than those of the branches before it.
    """
    order_branches(arm, target, search)
    search.known = math.inf
    for branch in range(search.branches):
        search.results[branch, OUTCOME] = NO_CONFIGURATION
        search.results[branch, ANGLE] = math.inf
        search.results[branch, BOUND] = math.inf
        search.best[branch, _ANGLE] = math.inf
        take_branch(arm, target, search, branch)
        write_pieces(arm, target, search, branch)
        sample_branch(arm, target, search, branch)
        if not every:
            search.known = min(search.known, search.best[branch, _ANGLE])
    for branch in range(search.branches):
        if search.counts[branch] > 0:
            take_branch(arm, target, search, branch)
            solve_branch(arm, target, search, branch, every)


@outlined
def solve_branch(arm, target, search, branch, every):
    """Search one branch; write its rows of search.results and search.qs."""
    results = search.results
    best = search.best
    outcome, bound = search_branch(arm, target, search, branch)
    results[branch, BOUND] = bound
    if best[branch, _ANGLE] < math.inf:
        if best[branch, _ANGLE] < search.known + _WORTH_POLISHING:
            polish(arm, target, search, branch, _POLISH_STEPS)
        angle = best[branch, _ANGLE]
        results[branch, OUTCOME] = outcome
        results[branch, ANGLE] = angle
        results[branch, BOUND] = min(bound, angle)
        write_joint_angles(arm, target, search, branch)
        if not every:
            search.known = min(search.known, angle)
    elif outcome == BOX_LIMIT:
        results[branch, OUTCOME] = outcome


@outlined
def solve_first_branch(arm, target, search):
    """Search the branch of the start alone; return whether it has a configuration."""
    order_branches(arm, target, search)
    search.known = math.inf
    search.best[0, _ANGLE] = math.inf
    take_branch(arm, target, search, 0)
    write_pieces(arm, target, search, 0)
    sample_branch(arm, target, search, 0)
    if search.counts[0] > 0:
        solve_branch(arm, target, search, 0, True)
    return search.best[0, _ANGLE] < math.inf


@outlined
def is_out_of_reach(arm, target, search, distance, angle):
    """Return whether it is proven that no configuration comes this near to the target.

    Args:
        arm: Block of ``ARM``.
        target: Block of ``TARGET``.
        search: Block of ``SEARCH``.
        distance: Metres between tool point and target, above 0.
        angle: Radians; π or more for any orientation.
    """
    angle = min(angle, math.pi)
    for branch in range(search.branches):
        take_branch(arm, target, search, branch)
        size = push_full_range(arm, target, search)
        evaluated = 0
        while size > 0:
            size -= 1
            first = search.boxes[size, 0]
            last = search.boxes[size, 1]
            evaluated += 1
            if box_bound(arm, target, search, first, last, angle + GAP, distance) > angle:
                continue
            if evaluated > _MAX_BOXES or last - first < distance * _SMALLEST_PROOF_BOX:
                return False
            middle = 0.5 * (first + last)
            size = push_box(search.boxes, size, first, middle, 0.0)
            size = push_box(search.boxes, size, middle, last, 0.0)
    return True


@inlined
def push_full_range(arm, target, search):
    """Push the full range of the parameter, cut at multiples of π/2; return the box count."""
    if target.by_turn:
        lower = arm.lower[4] + arm.turn_zero
        upper = arm.upper[4] + arm.turn_zero
    else:
        lower = target.azimuth - arm.upper[0]
        upper = target.azimuth - arm.lower[0]
    if upper - lower > _FULL_TURN:
        lower = -math.pi
        upper = math.pi
    lower -= _END_SLACK
    upper += _END_SLACK
    size = 0
    while lower < upper:
        end = min(upper, (math.floor(lower / _QUARTER_TURN + 1e-12) + 1.0) * _QUARTER_TURN)
        size = push_box(search.boxes, size, lower, end, 0.0)
        lower = end
    return size


@outlined
def track(arm, target, search):
    """Solve on the branch of the start, near its parameter; return whether an optimum is there.

    The roll or pan joint stops at its limit; it does not jump by a full turn.
    """
    order_branches(arm, target, search)
    branch = 0
    take_branch(arm, target, search, branch)
    write_pieces(arm, target, search, branch)
    start = search.start
    if target.by_turn:
        centre = start[4] + arm.turn_zero
        lower = arm.lower[4] + arm.turn_zero
        upper = arm.upper[4] + arm.turn_zero
    else:
        centre = target.azimuth - start[0]
        lower = target.azimuth - arm.upper[0]
        upper = target.azimuth - arm.lower[0]
    lower = max(lower, centre - _TRACK_WINDOW)
    upper = min(upper, centre + _TRACK_WINDOW)
    count = 0
    for k in range(search.counts[branch]):
        first = search.pieces[branch, 2 * k]
        last = search.pieces[branch, 2 * k + 1]
        shift = centre - 0.5 * (first + last)
        shift = _FULL_TURN * math.floor(shift / _FULL_TURN + 0.5)
        first = max(first + shift, lower)
        last = min(last + shift, upper)
        if last > first:
            search.pieces[branch, 2 * count] = first
            search.pieces[branch, 2 * count + 1] = last
            count += 1
    search.counts[branch] = count
    search.best[branch, _ANGLE] = math.inf
    sample_branch(arm, target, search, branch)
    if not search.best[branch, _ANGLE] < math.inf:
        return False
    polish(arm, target, search, branch, _POLISH_STEPS)
    distance = abs(search.best[branch, _PARAMETER] - centre)
    if distance > _TRACK_WINDOW - _AT_WINDOW_END:
        return False  # the optimum is outside
    write_joint_angles(arm, target, search, branch)
    largest = 0.0
    for k in range(5):
        largest = max(largest, abs(search.qs[branch, k] - start[k]))
    return largest <= _LONGEST_STEP
