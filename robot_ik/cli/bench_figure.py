"""``robot-ik bench figure``: the figure's motion beside what is wanted of it, judged by MuJoCo."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from rich.text import Text

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.environment import import_mujoco


@dataclass(frozen=True)
class BenchFigureOptions:
    """Measures walks, reaches, bends and jumps on the true shapes by MuJoCo's inverse dynamics.

    Exit code 0 where every figure is as wanted, else 1.
    """

    model: str = "humanoid"
    """A model whose robot.toml has a table [figure]."""
    count: int = 20
    """Balls reached, bent and jumped for."""
    seed: int = 0
    """Of the balls."""
    json: bool = False
    """Print JSON."""


def run(options: BenchFigureOptions) -> int:
    """Measures and prints."""
    import_mujoco()
    from robot_ik.bench.figure import measure_figure
    from robot_ik.figure.abilities import load_abilities
    from robot_ik.figure.figure import load_figure

    if options.count < 1:
        raise wrong("--count", f"{options.count} balls", "1 or more")
    with console.busy("measuring the figure"):
        abilities = load_abilities(load_figure(options.model))
        rows = list(measure_figure(abilities, options.count, options.seed))
    if options.json:
        console.print_json({"schema": 1, "rows": [asdict(row) | {"passed": row.passed} for row in rows]})
    else:
        shown = console.table("motion", "what", "measured", "wanted", "")
        for row in rows:
            low = f"{row.least:g} … " if row.least > -1e300 else "≤ "
            high = f"{row.most:g}" if row.most < 1e300 else ""
            target = f"≥ {row.least:g}" if not high else low + high
            mark = Text("yes", style="green") if row.passed else Text("NO", style="bold red")
            if row.missing:
                mark = Text("not measured", style="yellow")
            if row.least < -1e300 and row.most > 1e300:
                target, mark = "", Text("")
            value = row.missing or f"{row.value:.4g} {row.unit}".strip()
            shown.add_row(row.motion, row.what, value, target, mark)
        console.out().print(shown)
    return console.DONE if all(row.passed for row in rows) else console.NOT_ACHIEVED
