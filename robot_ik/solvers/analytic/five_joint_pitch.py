"""Arms with five joints: the best pitch for a fixed other parameter, in closed form.

The arm has a pan axis, three parallel pitch axes (lift, elbow, wrist) perpendicular to it, and a
roll axis perpendicular to the pitch axes. Names:

    pitch     angle of the roll axis in the arm plane
    bearing   azimuth of the tool point, seen from the pan joint
    turn      roll angle, counted from the angle at which the tool point is in the arm plane

A point (x, z) of the arm plane is the complex number x − iz, so that a pitch is a multiplication.
``docs/theory/five_joints.md`` derives the formulas.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined

# m. A limit that is exceeded by no more than this counts as met. Without this slack, a target
# exactly on the border of the workspace has no configuration.
ON_BOUNDARY = 2e-7
# rad. Excess over a joint limit that rounding may cause. The result is clipped.
LIMIT_SLACK = 1e-9
# The sine of the coupling may exceed 1 by this much through rounding.
SINE_SLACK = 1e-12

# Meaning of the angle: of the full orientation, or of the direction of one axis.
ALL_AXES, ONE_AXIS = range(2)

# Rows of ``ARM.ends``: the elbow seen from the shoulder with the lift joint at its lower and upper
# limit; the forearm with the wrist joint at its limits and the tool at pitch 0.
_LIFT_ENDS = (0, 1)
_WRIST_ENDS = (2, 3)

ARM = Layout(
    "FiveJointArm",
    shoulder_x="float",  # lift axis seen from the pan joint
    shoulder_y="float",
    upper_length="float",  # lift axis to elbow axis, m
    fore_length="float",  # elbow axis to wrist axis, m
    upper_angle="float",  # directions of these links at zero joint angles
    fore_angle="float",
    tool_x="float",  # foot of the tool point on the roll axis, seen from the wrist axis. The roll
    tool_y="float",  # axis is the real axis.
    side="float",  # offset of the roll axis from the pan axis along the pitch axes, m
    radius="float",  # distance of the tool point from the roll axis, m
    turn_zero="float",  # turn at zero roll
    pitch_zero="float",  # pitch at zero joint angles
    ends="table",  # (4, 2), see ``_LIFT_ENDS``
    lower="floats",  # (5,) limits of the joints, counted positive about the axes of the basis
    upper="floats",  # (5,)
    sheets="table",  # (s, 3) elbow branches: sign, shortest and longest shoulder-wrist distance
    basis="table",  # (3, 3) rows: forward, pitch axis, pan axis
    origin="floats",  # (3,) a point of the pan axis, world
    signs="floats",  # (5,) 1 or -1: sense of each joint about the axes of the basis
    tail="table",  # (3, 3) E in: tool orientation = basisᵀ Rz(pan) Ry(pitch) Rx(roll) E
    qadr="ints",  # (5,) coordinate of each joint in q
    vadr="ints",  # (5,) degree of freedom of each joint
)

# The target in the frame of the arm, the branch that is searched, and scratch memory.
TARGET = Layout(
    "FiveJointTarget",
    range="float",  # cylinder coordinates of the position about the pan axis
    azimuth="float",
    height="float",
    kind="int",  # ALL_AXES or ONE_AXIS
    by_turn="bool",  # the free parameter is the turn, not the bearing
    back="bool",  # the second solution of the coupling: the arm reaches backwards
    sign="float",  # of the elbow
    shortest="float",  # shoulder-wrist distance, m
    longest="float",
    matrix="table 3 3",  # K: the objective is tr(K Rz(pan) Ry(pitch) Rx(roll))
    edges="floats 32",
    tested="ints 32",
)


@inlined
def wrap(angle):
    """Return the angle in [-π, π)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@inlined
def is_inside(angle, lower, upper):
    """Return whether an angle lies within limits, modulo a full turn."""
    half = 0.5 * (upper - lower)
    return half >= math.pi or abs(wrap(angle - 0.5 * (lower + upper))) <= half + LIMIT_SLACK


@inlined
def angle_of_objective(objective, kind):
    """Return the angle in radians for a value of the objective."""
    cosine = objective if kind == ONE_AXIS else 0.5 * (objective - 1.0)
    return math.acos(min(1.0, max(-1.0, cosine)))


@inlined
def unit(angle):
    """Return exp(i angle)."""
    return complex(math.cos(angle), math.sin(angle))


@inlined
def length(vector):
    """Return the length of a plane vector."""
    return math.sqrt(vector.real * vector.real + vector.imag * vector.imag)


@inlined
def dot(a, b):
    """Return the dot product of two plane vectors."""
    return a.real * b.real + a.imag * b.imag


@inlined
def cross(a, b):
    """Return the cross product of two plane vectors."""
    return a.real * b.imag - a.imag * b.real


@inlined
def angle_from(a, b):
    """Return the angle that rotates the direction of a to that of b."""
    return math.atan2(cross(a, b), dot(a, b))


@inlined
def read_point(table, row):
    """Return a row of two numbers as a point of the arm plane."""
    return complex(table[row, 0], table[row, 1])


@inlined
def shoulder_of(arm):
    """Return the lift axis, seen from the pan joint."""
    return complex(arm.shoulder_x, arm.shoulder_y)


@inlined
def tool_at_turn(arm, turn):
    """Return the tool point in the arm plane at pitch 0, seen from the wrist axis."""
    return complex(arm.tool_x, arm.tool_y + arm.radius * math.cos(turn))


@inlined
def point_at_bearing(arm, target, bearing):
    """Return the target in the arm plane, seen from the shoulder."""
    return complex(target.range * math.cos(bearing), -target.height) - shoulder_of(arm)


@inlined
def elbow_bend(arm, sign, distance):
    """Return exp(i bend) of the elbow for a distance from shoulder to wrist.

    An elbow that cannot reach the distance is stretched or folded.
    """
    squares = arm.upper_length * arm.upper_length + arm.fore_length * arm.fore_length
    cosine = (distance * distance - squares) / (2.0 * arm.upper_length * arm.fore_length)
    cosine = min(1.0, max(-1.0, cosine))
    return complex(cosine, sign * math.sqrt((1.0 - cosine) * (1.0 + cosine)))


@outlined
def coupled(arm, target, parameter):
    """Return bearing and turn for a parameter, and the excess of the sine over [-1, 1].

    range sin(bearing) = side + radius sin(turn). The angle on the larger circle follows from the
    angle on the smaller circle.
    """
    if target.by_turn:
        sine = (arm.side + arm.radius * math.sin(parameter)) / target.range
    else:
        sine = (target.range * math.sin(parameter) - arm.side) / arm.radius
    other = math.asin(min(1.0, max(-1.0, sine)))
    if target.back:
        other = math.pi - other
    if target.by_turn:
        return other, parameter, abs(sine) - 1.0
    return parameter, other, abs(sine) - 1.0


# Pitches that the joint limits allow


@outlined
def allows_pitch(arm, target, point, tool, pitch, slack):
    """Return whether the wrist can be placed at a pitch with all pitch joints inside their limits.

    Args:
        arm: Block of ``ARM``.
        target: Block of ``TARGET``.
        point: Target seen from the shoulder.
        tool: Tool point seen from the wrist at pitch 0.
        pitch: Radians.
        slack: Metres. A limit counts as met if moving the tool point by at most ``slack`` can meet
            it.
    """
    heading = unit(pitch)
    wrist = point - heading * tool
    distance = length(wrist)
    if distance < target.shortest - slack or distance > target.longest + slack:
        return False
    bend = elbow_bend(arm, target.sign, distance)
    chord = arm.upper_length + arm.fore_length * bend
    upper_direction = angle_from(chord, wrist)
    lift = upper_direction - arm.upper_angle
    lift_is_inside = is_inside(lift, arm.lower[1], arm.upper[1])
    if not lift_is_inside and not is_near_lift_limit(arm, target, wrist, slack):
        return False
    fore_direction = upper_direction + math.atan2(bend.imag, bend.real)
    wrist_angle = pitch - arm.pitch_zero - (fore_direction - arm.fore_angle)
    if is_inside(wrist_angle, arm.lower[3], arm.upper[3]):
        return True
    return is_near_wrist_limit(arm, target, heading, wrist, slack)


@inlined
def is_near_lift_limit(arm, target, wrist, slack):
    """Return whether a move of the tool point by ``slack`` can meet a limit of the lift joint."""
    for row in _LIFT_ENDS:
        elbow = read_point(arm.ends, row)
        rest = wrist - elbow
        same_elbow = target.sign * cross(elbow, rest) >= -slack * arm.upper_length
        if same_elbow and abs(length(rest) - arm.fore_length) <= slack:
            return True
    return False


@inlined
def is_near_wrist_limit(arm, target, heading, wrist, slack):
    """Return whether a move of the tool point by ``slack`` can meet a limit of the wrist joint."""
    for row in _WRIST_ENDS:
        fore = heading * read_point(arm.ends, row)
        same_elbow = target.sign * cross(wrist, fore) >= -slack * arm.fore_length
        if same_elbow and abs(length(wrist - fore) - arm.upper_length) <= slack:
            return True
    return False


@inlined
def add_circle(edges, count, centre, lever, distance):
    """Append the pitches with |centre − lever exp(i pitch)| = distance to ``edges``."""
    squares = dot(centre, centre) + dot(lever, lever)
    product = math.sqrt(dot(centre, centre) * dot(lever, lever))
    if distance >= 0.0 and product > 0.0:
        cosine = (squares - distance * distance) / (2.0 * product)
        if abs(cosine) <= 1.0:
            middle = angle_from(lever, centre)
            half = math.acos(cosine)
            edges[count] = middle - half
            edges[count + 1] = middle + half
            return count + 2
    return count


@inlined
def add_sine(edges, count, first, lever, value):
    """Append the pitches with first × (lever exp(i pitch)) = value to ``edges``."""
    product = math.sqrt(dot(first, first) * dot(lever, lever))
    if product > 0.0 and abs(value) <= product:
        middle = angle_from(lever, first)
        angle = math.asin(value / product)
        edges[count] = middle + angle
        edges[count + 1] = middle + math.pi - angle
        return count + 2
    return count


@outlined
def write_edges(arm, target, point, tool, slack):
    """Write every pitch at which ``allows_pitch`` may change to target.edges; return their number.

    Each limit is one circle equation. With a slack there are two circles, and an equation for the
    sign of the elbow.
    """
    edges = target.edges
    count = add_circle(edges, 0, point, tool, target.shortest - slack)
    count = add_circle(edges, count, point, tool, target.longest + slack)
    for row in _LIFT_ENDS:
        elbow = read_point(arm.ends, row)
        rest = point - elbow
        count = add_circle(edges, count, rest, tool, arm.fore_length - slack)
        if slack > 0.0:
            count = add_circle(edges, count, rest, tool, arm.fore_length + slack)
            value = cross(elbow, rest) + target.sign * slack * arm.upper_length
            count = add_sine(edges, count, elbow, tool, value)
    for row in _WRIST_ENDS:
        fore = read_point(arm.ends, row)
        count = add_circle(edges, count, point, tool + fore, arm.upper_length - slack)
        if slack > 0.0:
            count = add_circle(edges, count, point, tool + fore, arm.upper_length + slack)
            value = cross(tool, fore) - target.sign * slack * arm.fore_length
            count = add_sine(edges, count, point, fore, value)
    for k in range(count):
        target.tested[k] = 0
    return count


@outlined
def nearest_edge(arm, target, point, tool, wanted, slack, count):
    """Return the distance from ``wanted`` to the nearest allowed edge, this edge, and a count.

    Forbidden edges are removed from target.edges; the count is the number of edges left. The
    distance is inf if no edge is allowed.
    """
    edges = target.edges
    tested = target.tested
    while count > 0:
        nearest = 0
        distance = math.inf
        for k in range(count):
            angle = abs(wrap(edges[k] - wanted))
            if angle < distance:
                distance = angle
                nearest = k
        edge = edges[nearest]
        if tested[nearest] == 1 or allows_pitch(arm, target, point, tool, edge, slack):
            tested[nearest] = 1
            return distance, edge, count
        count -= 1
        edges[nearest] = edges[count]
        tested[nearest] = tested[count]
    return math.inf, 0.0, 0


# The objective


@inlined
def panned(matrix, c, s):
    """Return K Rz(pan) as a tuple of rows, for cos and sin of the pan angle."""
    return (
        (matrix[0, 0] * c + matrix[0, 1] * s, matrix[0, 1] * c - matrix[0, 0] * s, matrix[0, 2]),
        (matrix[1, 0] * c + matrix[1, 1] * s, matrix[1, 1] * c - matrix[1, 0] * s, matrix[1, 2]),
        (matrix[2, 0] * c + matrix[2, 1] * s, matrix[2, 1] * c - matrix[2, 0] * s, matrix[2, 2]),
    )


@inlined
def pitch_terms(a, c, s):
    """Return the constant, cosine and sine term of tr(A Ry(pitch) Rx(roll)).

    ``c`` and ``s`` are cos and sin of the roll.
    """
    constant = a[1][1] * c - a[2][1] * s
    cosine = a[0][0] + a[1][2] * s + a[2][2] * c
    sine = -a[0][2] + a[1][0] * s + a[2][0] * c
    return constant, cosine, sine


@outlined
def best_pitch(arm, target, parameter):
    """Return the smallest angle for one parameter, and its pitch; the angle is inf if none exists.

    The objective is constant + amplitude · cos(pitch − wanted). The best pitch is the allowed pitch
    nearest to ``wanted``.
    """
    bearing, turn, excess = coupled(arm, target, parameter)
    if excess > SINE_SLACK:
        return math.inf, 0.0
    point = point_at_bearing(arm, target, bearing)
    tool = tool_at_turn(arm, turn)
    pan = target.azimuth - bearing
    roll = turn - arm.turn_zero
    matrix = panned(target.matrix, math.cos(pan), math.sin(pan))
    constant, cosine, sine = pitch_terms(matrix, math.cos(roll), math.sin(roll))
    pitch = math.atan2(sine, cosine)
    distance = 0.0
    if not allows_pitch(arm, target, point, tool, pitch, ON_BOUNDARY):
        count = write_edges(arm, target, point, tool, 0.0)
        distance, pitch, _ = nearest_edge(arm, target, point, tool, pitch, ON_BOUNDARY, count)
        if distance == math.inf:
            return math.inf, 0.0
    amplitude = math.sqrt(cosine * cosine + sine * sine)
    return angle_of_objective(constant + amplitude * math.cos(distance), target.kind), pitch
