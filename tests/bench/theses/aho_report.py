"""Print at which frames A00's update loses the goal, by the axes that it uses.

python tests/bench/theses/aho_report.py            the tables of docs/theory/experiments.md
python tests/bench/theses/aho_report.py FILE.png   and the picture (needs matplotlib)
"""

from __future__ import annotations

import sys

from aho_courses import STARTS, Course, course, start_of_six
from aho_update import ALIKE, CLOSE, MIXED, UPDATES, Update, follow


def _cell(lost: float | None) -> str:
    return "ok" if lost is None else f"{lost:.0f}"


def main() -> None:
    """Print the tables, and draw the picture if a file is named."""
    courses = [course(number) for number in range(1, 14)]
    print("Where the goal is lost, by axes of J's columns and axes of the increments.")
    print("Degrees; tests 11 and 12: units of length.")
    print(f"{'columns':9s}{'applied':9s}", *(f"{c.number:4d}" for c in courses))
    for update in UPDATES:
        print(
            f"{update.columns:9s}{update.applied:9s}",
            *(f"{_cell(c.lost_at(update)):>4s}" for c in courses),
        )
    print("\nThe same with one more thing changed")
    for what, update in {
        "world, body, 1000 iterations": Update("world", "body", iterations=1000),
        "world, body, one rotation a step": Update("world", "body", exact=True),
        "world, body, singular values": Update("world", "body", svd=True),
        "world, world, singular values": Update("world", "world", svd=True),
    }.items():
        print(f"{what:34s}", *(f"{_cell(c.lost_at(update)):>4s}" for c in courses))
    print("\nTest 6 from other starts: world, body; world, world")
    for name in STARTS:
        six = start_of_six(name)
        print(f"{name:34s}", *(f"{_cell(six.lost_at(update)):>4s}" for update in (MIXED, ALIKE)))
    if len(sys.argv) > 1:
        draw(courses[5], sys.argv[1])


def draw(six: Course, file: str) -> None:
    """Draw the distance from the goal in test 6, for mixed and for equal axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.8), dpi=110, layout="constrained")
    axes = figure.subplots()
    for update, colour, label in (
        (ALIKE, "#08519c", "columns and increments about the world's axes"),
        (MIXED, "#d94801", "columns about the world's axes, increments about the joint's own"),
    ):
        lost, distances = follow(six.chain, six.goals, update, oriented=False)
        axes.plot(six.at[: len(distances)], distances, color=colour, lw=1.2, label=label)
        if lost is not None:
            at = float(six.at[lost])
            axes.plot([at], [distances[-1]], "x", color=colour, ms=9, mew=2)
            axes.annotate(
                f"lost at {at:.0f}°", (at, distances[-1]), (8, 4), textcoords="offset points"
            )
    axes.axhline(CLOSE, color="#9a9a9a", lw=0.8, ls="--")
    axes.text(60.0, CLOSE, "tolerance of the thesis", color="#6a6a6a", va="bottom", ha="right")
    axes.set(
        xlim=(0.0, 60.0),
        ylim=(0.0, 0.75),
        xlabel="the goal has turned by, degrees",
        ylabel="distance",
    )
    axes.set_title("A00, test 6: tip to goal, length units")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=9, loc="outside lower center")
    figure.savefig(file)


if __name__ == "__main__":
    main()
