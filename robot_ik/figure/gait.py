"""Gaits: the parameters of a walk, and the states of a foot's contact with the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

AIR, HEEL, FLAT, TOE = range(4)
"""Contact of a foot: in the air, on its heel, flat on the floor, or on its toes."""

CONTACTS = ("air", "heel", "flat", "toe")
"""Names of these states."""


@dataclass(frozen=True)
class Gait:
    """Parameters of a gait. Lengths in m, times in s, angles in degrees.

    A cycle is two steps. A share of the swing is counted from toe off to heel strike.

    Attributes:
        length: Length of a step.
        width: Distance between the lines of the two feet.
        time: Time from strike to strike.
        double: Time on both feet in each step.
        strike_deg: Pitch of the sole at heel strike, toes up.
        off_deg: Pitch of the sole at toe off.
        peak: Largest pitch of the sole, as a multiple of the pitch at toe off.
        flat: Share of the cycle after the strike at which the sole is flat.
        drop: Speed at which the sole falls at its strike, as a share of its mean speed until it is
            flat.
        rise: Share of the cycle at which the heel leaves the floor.
        level_share: Share of the swing at which the sole is nearly level.
        level_pitch: Pitch of the nearly level sole, as a share of the pitch at toe off.
        lift: Clearance of the lowest point in mid swing.
        lift_power: Power by which the clearance grows.
        fall_power: Power by which it shrinks. A smaller power keeps the clearance longer.
        level_time: Time in which the toes straighten after they left the floor.
        gap: Smallest distance of the swinging foot from the line of the standing foot.
        knee_deg: Smallest bend of the knees.
        toe_out_deg: Rotation of the toes outwards.
        pressure_start: Zero-moment point at the start of single support, in front of the ankle.
        pressure_end: Zero-moment point at its end, in front of the ankle.
        dip: Time after a strike at which the pelvis is lowest.
        bob: Range of the pelvis up and down.
        broad: Excess of the time in which the pelvis is up over that in which it is down; 0 is a
            cosine.
        late: Delay of the swinging foot against a cosine. A foot that waits before its strike
            holds the hips down.
        depart: Softness of the start of the swing: 2.47 has no acceleration, 0 is a cosine.
        arrive: Speed of the foot at its strike, as a share of its mean speed in the air. Heels
            strike while they still move.
        turn_deg: Rotation of the pelvis about the vertical, towards the leg in front.
        lean_deg: Lean of the chest forwards.
        swing_deg: Swing of the arms.
    """

    length: float = 0.62531
    width: float = 0.08042
    time: float = 0.56303
    double: float = 0.09387
    strike_deg: float = 11.63986
    off_deg: float = 45.89719
    peak: float = 1.41342
    flat: float = 0.11029
    drop: float = 0.27861
    rise: float = 0.43639
    level_share: float = 0.5568
    level_pitch: float = 0.15208
    lift: float = 0.02781
    lift_power: float = 2.35311
    fall_power: float = 2.22706
    level_time: float = 0.36806
    gap: float = 0.11
    knee_deg: float = 12.15722
    toe_out_deg: float = 5.0
    pressure_start: float = 0.04256
    pressure_end: float = 0.1669
    dip: float = -0.02876
    bob: float = 0.02804
    broad: float = 0.23502
    late: float = -0.29299
    depart: float = 2.08331
    arrive: float = 0.16313
    turn_deg: float = 4.55665
    lean_deg: float = 3.0
    swing_deg: float = 15.0


WALK = Gait()
"""Walk of the humanoid. ``python -m benchmarks.figure.tune_gait`` tunes these numbers."""

SHUFFLE = replace(
    WALK,
    length=0.3,
    width=0.095,
    time=0.62,
    double=0.16,
    strike_deg=0.0,
    off_deg=14.0,
    peak=1.1,
    flat=0.069,
    rise=0.5,
    level_share=0.6,
    level_pitch=0.1,
    lift=0.045,
    lift_power=3.0,
    fall_power=3.0,
    level_time=0.3,
    knee_deg=12.0,
    toe_out_deg=0.0,
    pressure_start=0.03,
    pressure_end=0.05,
    dip=0.006,
    bob=0.0,
    broad=0.0,
    late=0.014,
    depart=0.0,
    arrive=0.0,
    turn_deg=4.5,
    lean_deg=-0.4,
    swing_deg=4.0,
)
"""Small steps to any side, and turns on the spot. Set by hand."""


@dataclass(frozen=True)
class WalkOptions:
    """Parameters that all walks share.

    Attributes:
        stance: Share of the cycle in which a foot stands (Schwartz et al. 2008: 60 to 61 %).
        begin: Time before the first step, s. The body needs some multiples of 1/ω to lean.
        settle: Time after the last strike, s. The body needs some multiples of 1/ω to come to rest.
        stand_pressure: Zero-moment point at rest, in front of the ankle, m.
        last_pressure: Zero-moment point at the end of the last single support, in front of the
            ankle, m.
        stop_time: Time from the last strike until the zero-moment point is in the middle, s.
        leaving_deg: Smallest bend of a knee whose foot leaves the floor, degrees. A straight knee
            would have to bend at once.
        leaving_time: Time before and after toe off in which the knee has that bend, s.
        min_off: Pitch of the sole at toe off for a step of no length, as a share of that for a
            whole step.
        first_off: Largest pitch at toe off of a foot that stood at the start, as a share.
        last_strike: Largest pitch at the last strike of a foot, as a share.
        toe_turn: Share of the swing after toe off at which the pitch is largest.
        soften: Time over which heights of a foot in the air are smoothed, s.
        soften_in: Share of the swing at its start in which the smoothing grows.
        soften_out: Share of the swing at its end in which it fades.
        corrections: Rounds in which the dynamics of the whole body correct the centre of mass.
        learning_knee_deg: Bend of the knees in the first pass, degrees. The pass determines the
            position of the pelvis relative to the centre of mass.
        learning_extra_deg: Additional bend of the knees in the second pass, degrees.
        pelvis_behind: Distance of the pelvis behind the centre of mass in the first pass, m.
        largest_error: Largest error of the zero-moment point that one round corrects, m.
        error_time: Time over which errors of the zero-moment point are smoothed, s.
        tilt_deg: Forward tilt of the pelvis, degrees.
        sway_deg: Tilt of the pelvis to the sides, degrees.
        gaze_distance: Distance of the point at which the eyes look, m.
        gaze_drop: Height of that point below the eyes, m.
    """

    stance: float = 0.61
    begin: float = 0.75
    settle: float = 1.4
    stand_pressure: float = 0.03
    last_pressure: float = 0.05
    stop_time: float = 0.35
    leaving_deg: float = 27.0
    leaving_time: float = 0.08
    min_off: float = 0.45
    first_off: float = 0.75
    last_strike: float = 0.3
    toe_turn: float = 0.14
    soften: float = 0.025
    soften_in: float = 0.3
    soften_out: float = 0.25
    corrections: int = 4
    learning_knee_deg: float = 22.0
    learning_extra_deg: float = 4.0
    pelvis_behind: float = 0.012
    largest_error: float = 0.12
    error_time: float = 0.02
    tilt_deg: float = 4.0
    sway_deg: float = 4.0
    gaze_distance: float = 3.0
    gaze_drop: float = 0.2


WALKING = WalkOptions()
"""The parameters of all walks."""
