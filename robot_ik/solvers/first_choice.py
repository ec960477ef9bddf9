"""Which method ``auto`` asks first, by the arm's closed form and by whether the start is near the goal.

Made by ``python docs/make/measure_first_choice.py --write``; nothing is timed when a goal is solved.
"""

from __future__ import annotations

#: (closed form, "cold" or "warm") -> the quicker method; what is missing is left to the closed form.
FIRST_CHOICE: dict[tuple[str, str], str] = {
    ("limb", "cold"): "lm",
    ("limb", "warm"): "lm",
    ("spherical_wrist", "cold"): "analytic",
    ("spherical_wrist", "warm"): "lm",
    ("three_parallel", "cold"): "analytic",
    ("three_parallel", "warm"): "lm",
}
