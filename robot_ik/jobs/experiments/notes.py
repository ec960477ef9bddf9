"""What has to be said beside the numbers: what is chosen, what differs, what the theses do not state."""

from __future__ import annotations

from robot_ik.jobs.experiments import courses, s12

A00_CHOICES = (
    *courses.SHARED,
    "tolerance 0.1 mm and 1 mrad (his: 0.5 length units and at most 16 iterations)",
    "each goal has a witness: the chain is drawn to it (a circular arc; the last link as the orientation "
    "says), or, in test 13, the goal is made from joint angles; MuJoCo's forward pass checks it",
    "a frame counts where MuJoCo's forward pass finds the goal met",
)

S12_CHOICES = (
    "model: seven_segment, 7 segments of 1 m, three hinges a joint (21); limits, where there are any: "
    f"±{s12.LIMIT:g}° about x and z, the twist free",
    f"curve: segment 1 upright, twisted once round in {s12.LAP} frames; joints 2 to 7 bent alike about x, "
    f"by {s12.BEND:g}° + {s12.WAVE:g}° sin {s12.WAVES}φ: a closed wave round the arm",
    "random: where random joint angles (inside the limits of the case, else ±180°) put the tip, a new one "
    "each frame",
    "so each target has a witness; each frame starts from the last answer, the first from its witness",
    "a frame counts where MuJoCo's forward pass finds the tip within 0.05 m",
)

S12_DIFFERENCES = (
    "t: a compiled kernel on a machine of today against a program of 2012; the unit ms is assumed for his",
    "N: of ccd, turns of single bones; here a sweep turns 21 hinges and counts as 7",
    "ccd solves more: each hinge takes its exact optimum inside its limits, and all targets can be reached",
    f"α = {s12.ALPHA:g}, read as the share of a step that is taken: an exact step then leaves 99 % of the "
    "way, 100 of them 37 %, so that only what begins within 0.14 m can end within 0.05 m. Hence nearly 0 % "
    "of random targets. His 15 and 47 % of transpose and pseudoinverse cannot come from α so read, his 0 % "
    "of dls can",
    f"so α is also read in degrees, {s12.IN_DEGREES:.3f} of a step in radians: then nearly all is solved, "
    "more than his. Neither reading gives his table",
    f"dls: λ = {s12.LAMBDA:g} in metres, as in his equation, with our segments of 1 m; his are unknown. A "
    "longest step shortens the whole step here, so that its direction stays",
    "Jacobian: 21 real hinges here; he gives each bone one axis, (s - p) × (t - p), chosen anew at each "
    "step. The target is in the Jacobian as in his (the option alternative)",
    "cases 3 and 4: here a joint at its limit leaves the step to the others, and his share drops far more "
    "than ours",
    "no restarts in the two columns of his parameters; with ours, methods may restart",
)

S12_NOT_STATED = (
    "the lengths of the segments",
    "the curve, and the pace along it",
    "the box of the random targets, and how many of them can be reached at all",
    "the joints' freedoms, and how the Jacobian methods keep inside the limits",
    "the units of t and of α",
    "whether and where e is clamped (ClampMag)",
    "from where each solve starts",
)
