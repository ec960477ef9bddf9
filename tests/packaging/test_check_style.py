"""The style check of `make lint`: each rule can fail."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / ".ci" / "check_style.py"

GOOD = '''"""A module that follows every rule."""


def double(value: float) -> float:
    """Return twice the value."""
    return 2.0 * value
'''
LONG_LINE = '"""A module."""\n\nTEXT = "' + 95 * "x" + '"\n'
PACKED = '"""A module."""\n\nWIDTH, HEIGHT = 640, 480\n'
UNUSED = GOOD.replace("value: float)", "value: float, other: float)")
NO_DOCSTRING = GOOD.replace('    """Return twice the value."""\n', "")
TWO_STATEMENTS = '"""A module."""\n\nWIDTH = 640; HEIGHT = 480\n'
LAYOUT = '"""A module."""\n\nWIDTH  =  640\n'
#: The formatter breaks this line at 100 characters.
WIDE_CALL = '"""A module."""\n\nprint(' + ", ".join(["123456789"] * 9) + ")\n"


@pytest.fixture(scope="module")
def style() -> ModuleType:
    spec = importlib.util.spec_from_file_location("check_style", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["check_style"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the project's ruff settings."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def rules(style: ModuleType, source: str) -> list[str]:
    return [finding.rule for finding in style.check_source("module.py", source)]


@pytest.mark.parametrize(
    "source",
    [
        "A, B = 1, 2",
        "(a, b) = (c, d)",
        "[a, b] = [1, 2]",
        "self.a, self.b = a, b",
        "def f():\n    x, y = 1, g(2)",
        "class C:\n    a, b = 1, 2",
        "a, b = a + 1, b + 1",
        "a, (b, c) = 1, pair",
    ],
)
def test_packed_assignments_are_rejected(style: ModuleType, source: str) -> None:
    assert rules(style, source) == ["STY001"]


@pytest.mark.parametrize(
    "source",
    [
        "a, b = b, a",
        "a, b, c = b, c, a",
        "x[i], x[j] = x[j], x[i]",
        "a, b = b, a + b",
        "x, y = c * x - s * y, s * x + c * y",
        "a, b = pair",
        "a, b = pair()",
        "a, b = (f(x) for x in 'ab')",
        "first, *rest = 1, 2, 3",
        "a = 1, 2",
        "for a, b in ((1, 2), (3, 4)):\n    pass",
    ],
)
def test_swaps_and_unpacking_are_accepted(style: ModuleType, source: str) -> None:
    assert rules(style, source) == []


@pytest.mark.parametrize(
    "comment",
    [
        "# -----",
        "# ------ devices",
        "# devices ------",
        "# === a ===",
        "########",
        "# ─────",
        "# ~~~",
    ],
)
def test_banners_are_rejected(style: ModuleType, comment: str) -> None:
    assert rules(style, f"a = 1\n{comment}\nb = 2\n") == ["STY002"]


@pytest.mark.parametrize(
    "line", ["# from -1 to 1", "# a -> b", "#: Documented.", "#", "text = '# -----'", "# x == y"]
)
def test_other_comments_are_accepted(style: ModuleType, line: str) -> None:
    assert rules(style, f"a = 1\n{line}\n") == []


SKIP = "# fmt: " + "skip"
OFF = "# fmt: " + "off"


@pytest.mark.parametrize(
    "source",
    [
        f"call(\n    a, b,\n    c,\n)  {SKIP}",
        f"NAMES = [\n    'a', 'b',\n    'c', 'd',\n]  {SKIP}",
        f"if a:  {SKIP}\n    b = [1, 2, 3, 4]",
        f"def f(  {SKIP}\n    a, b,\n): return [1, 2, 3, 4]",
        f"{OFF}\ncall(a,\n     b)\n# fmt: on",
        f"PAIR = (1,\n 2)  {SKIP}",
    ],
)
def test_a_layout_by_hand_is_rejected_outside_tables(style: ModuleType, source: str) -> None:
    assert rules(style, source) == ["STY003"]


@pytest.mark.parametrize(
    "source",
    [
        f"LENGTHS = (\n    1.0, -2.0,\n    3e-3, 4 * 2,\n)  {SKIP}",
        f"ROTATION = np.array([\n    [c, -s, 0.0],\n    [s,  c, 0.0],\n])  {SKIP}",
        f"JOINTS = [\n    ('waist', -1.0, 1.0),\n    ('elbow', -2.0, 2.0),\n]  {SKIP}",
        f"RANGES = {{\n    'waist': (-1.0, 1.0),\n    'elbow': (-2.0, 2.0),\n}}  {SKIP}",
        f"{OFF}\nM = [[1,  0],\n     [0, -1]]\n# fmt: on",
        f"@parametrize('a, b', [\n    (1,  2),\n    (10, 3),\n])  {SKIP}\ndef f(a, b): ...",
    ],
)
def test_a_layout_by_hand_is_accepted_in_tables(style: ModuleType, source: str) -> None:
    assert rules(style, source) == []


@pytest.mark.parametrize(
    ("source", "rule", "line"),
    [
        (LONG_LINE, "E501", 3),
        (PACKED, "STY001", 3),
        (UNUSED, "ARG001", 4),
        (NO_DOCSTRING, "D103", 4),
        (TWO_STATEMENTS, "E702", 3),
        (LAYOUT, "FMT", 3),
    ],
)
def test_a_file_must_follow_every_rule(
    style: ModuleType,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
    source: str,
    rule: str,
    line: int,
) -> None:
    (checkout / "good.py").write_text(GOOD)
    (checkout / "bad.py").write_text(source)
    assert style.main([], checkout) == 1
    printed = capsys.readouterr().out
    assert f"bad.py:{line}: {rule} " in printed
    assert "good.py" not in printed
    advised = printed.partition("What to write instead:")[2]
    assert any(rule.startswith(row.split(":")[0].strip()) for row in advised.splitlines() if row)


def test_a_checkout_that_follows_prints_nothing(
    style: ModuleType, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (checkout / "good.py").write_text(GOOD)
    assert style.main([], checkout) == 0
    assert capsys.readouterr().out == ""


def test_format_lays_out_the_files_that_need_it(style: ModuleType, checkout: Path) -> None:
    (checkout / "wide.py").write_text(WIDE_CALL)
    (checkout / "good.py").write_text(GOOD)
    assert style.main(["--format"], checkout) == 0
    assert (checkout / "wide.py").read_text().count("\n") > 3
    assert (checkout / "good.py").read_text() == GOOD
    assert style.main([], checkout) == 0
