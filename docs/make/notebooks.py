"""Run the notebooks and store the outputs of their cells.

    python docs/make/notebooks.py [FILE ...]

By default it runs all files of docs/notebooks/. A cell with the tag `live` runs, but its output
is not stored: its server ends with this program. Needs the extras `web` and `plots`.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import sys
import types
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot
from matplotlib.figure import Figure

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
#: Dots per inch of the stored figures.
RESOLUTION = 90
LIVE = "live"

Cell = dict[str, Any]


def source_of(cell: Cell) -> str:
    """Return the text of a cell."""
    return "".join(cell["source"])


def run_cell(source: str, name: str, namespace: dict[str, Any]) -> tuple[str, object]:
    """Run a cell as a notebook does.

    Args:
        source: Python text.
        name: Name of the cell for tracebacks.
        namespace: Names of the notebook. The cell changes them.

    Returns:
        What the cell printed, and the value of its last line if that is an expression, else None.
    """
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    value = None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, name, "exec", dont_inherit=True), namespace)
        if last is not None:
            expression = ast.Expression(last.value)
            value = eval(compile(expression, name, "eval", dont_inherit=True), namespace)
    return printed.getvalue(), value


def shown(value: object) -> dict[str, str]:
    """Return what a notebook shows for a value: MIME type -> content."""
    if isinstance(value, Figure):
        stream = io.BytesIO()
        value.savefig(stream, format="png", dpi=RESOLUTION, bbox_inches="tight")
        return {"image/png": base64.b64encode(stream.getvalue()).decode()}
    if hasattr(value, "_repr_png_"):
        return {"image/png": base64.b64encode(value._repr_png_()).decode()}
    if hasattr(value, "_repr_html_"):
        return {"text/html": value._repr_html_()}
    return {"text/plain": repr(value)}


def outputs_of(printed: str, value: object, count: int) -> list[Cell]:
    """Return the outputs of a cell in the format of notebooks."""
    outputs: list[Cell] = []
    if printed:
        text = printed.splitlines(keepends=True)
        outputs.append({"name": "stdout", "output_type": "stream", "text": text})
    if value is not None:
        outputs.append(
            {
                "data": shown(value),
                "execution_count": count,
                "metadata": {},
                "output_type": "execute_result",
            }
        )
    return outputs


def run_notebook(content: Cell, name: str) -> dict[str, Any]:
    """Run all cells of a notebook and write their outputs into it.

    Args:
        content: The notebook. Its code cells get outputs.
        name: Name for tracebacks.

    Returns:
        The names that the cells made.
    """
    module = types.ModuleType(name)
    namespace = module.__dict__
    count = 0
    for k, cell in enumerate(content["cells"], 1):
        if cell["cell_type"] != "code":
            continue
        count += 1
        printed, value = run_cell(source_of(cell), f"{name}, cell {k}", namespace)
        shows = LIVE not in cell["metadata"].get("tags", ())
        cell["outputs"] = outputs_of(printed, value, count) if shows else []
        cell["execution_count"] = count
    pyplot.close("all")
    return namespace


def main(names: list[str]) -> None:
    """Run the notebooks of those names, by default all."""
    files = [Path(name) for name in names] or sorted(FOLDER.glob("*.ipynb"))
    for file in files:
        content = json.loads(file.read_text(encoding="utf-8"))
        run_notebook(content, file.name)
        text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
        file.write_text(text, encoding="utf-8")
        print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
