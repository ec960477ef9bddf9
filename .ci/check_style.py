"""Check the style of the source files. `make lint` calls it without options.

Every file must follow the rules in pyproject.toml (ruff check and ruff format) and these:

| rule | what is rejected |
|---|---|
| STY001 | `a, b = 1, 2`: a tuple assignment whose parts could be separate statements |
| STY002 | a comment that is a ruler or a banner: `# -----` |
| STY003 | `# fmt: skip` or `# fmt: off` on anything but a table of numbers |

Usage:
    python .ci/check_style.py             check all files
    python .ci/check_style.py --format    apply the fixes of ruff and format all files
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Smallest number of numbers in a table that may have its own layout.
TABLE_NUMBERS = 4

ADVICE = {
    "ARG": "remove the argument, or start its name with an underscore if a caller passes it",
    "D": "write a Google docstring: one summary line, then Args, Returns and Raises",
    "E501": "break the line; `make format` breaks code, text and comments are broken by hand",
    "E70": "write one statement per line",
    "FMT": "run `make format`",
    "I001": "run `make format`",
    "STY001": "write one assignment per line",
    "STY002": "remove the banner; split the file if it needs headings",
    "STY003": "remove the comment and let the formatter lay the statement out",
}

_BANNER = re.compile(r"#[\s#]*([-=*~_#─━]{3,}.*|.*[-=*~_─━]{3,}\s*)")
_FORMATTER_SWITCH = re.compile(r"#\s*(fmt:\s*(skip|off)|yapf:\s*disable)")
_RUFF_LINE = re.compile(r"(?P<path>.+?):(?P<line>\d+):\d+: (?P<rule>[A-Z]+\d+|[\w-]+)(?P<text>.*)")


@dataclass(frozen=True, order=True)
class Finding:
    """One violation of a rule. Line 0 means the whole file."""

    path: str
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        place = f"{self.path}:{self.line}" if self.line else self.path
        return f"{place}: {self.rule} {self.text}"


def check_source(path: str, source: str) -> list[Finding]:
    """Return the findings of the rules STY001 to STY003 in the text of one Python file."""
    tree = ast.parse(source, filename=path)
    findings = [
        Finding(path, node.lineno, "STY001", "several values are assigned in one statement")
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and is_packed_assignment(node)
    ]
    if _BANNER.search(source) or _FORMATTER_SWITCH.search(source):
        findings += _check_comments(path, source, tree)
    return sorted(findings)


def is_packed_assignment(node: ast.Assign) -> bool:
    """Return whether a tuple assignment could be written as separate statements in the same order.

    A swap could not: a later value reads an earlier target. Unpacking one value is no packing.
    """
    values = _elements(node.value)
    for target_node in node.targets:
        targets = _elements(target_node)
        if len(targets) < 2 or len(targets) != len(values):
            continue
        if any(isinstance(element, ast.Starred) for element in (*targets, *values)):
            continue
        if not _reads_earlier_target(targets, values):
            return True
    return False


def _elements(node: ast.expr) -> list[ast.expr]:
    return node.elts if isinstance(node, ast.Tuple | ast.List) else []


def _reads_earlier_target(targets: Sequence[ast.expr], values: Sequence[ast.expr]) -> bool:
    written: set[str] = set()
    for target, value in zip(targets, values, strict=True):
        read = {ast.unparse(node) for node in ast.walk(value) if isinstance(node, ast.expr)}
        if read & written:
            return True
        written.add(ast.unparse(target))
    return False


def _check_comments(path: str, source: str, tree: ast.Module) -> Iterator[Finding]:
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        line = token.start[0]
        if _BANNER.fullmatch(token.string):
            yield Finding(path, line, "STY002", "banner comment")
            continue
        switch = _FORMATTER_SWITCH.match(token.string)
        if switch and not _governs_table(switch[1], line, tree):
            yield Finding(path, line, "STY003", f"`# {switch[1]}` on no table of numbers")


def _governs_table(switch: str, line: int, tree: ast.Module) -> bool:
    """Return whether the formatter is switched off for a table of numbers.

    The comment belongs to the statement or decorator around it, `fmt: off` to the next statement.
    """
    around: list[ast.stmt | ast.expr] = []
    behind: list[ast.stmt] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            around += [d for d in node.decorator_list if d.lineno <= line <= _end(d)]
        elif isinstance(node, _SIMPLE):
            if node.lineno <= line <= _end(node):
                around.append(node)
            elif node.lineno > line:
                behind.append(node)
    if around:
        return any(holds_table(node) for node in around)
    if not behind or "skip" in switch:
        return False
    return holds_table(min(behind, key=lambda node: node.lineno))


_SIMPLE = (ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Return, ast.Expr, ast.Assert)


def _end(node: ast.stmt | ast.expr) -> int:
    return node.end_lineno or node.lineno


def holds_table(node: ast.stmt | ast.expr) -> bool:
    """Return whether a statement or an expression is a matrix or a table of numbers.

    It may be an argument of a call such as ``np.array``. Rows may begin with a name. A matrix may
    hold expressions of variables, as rotations do.
    """
    if isinstance(node, ast.Assert):
        return any(holds_table(part) for part in ast.walk(node.test) if isinstance(part, ast.Call))
    value = getattr(node, "value", None)
    if isinstance(node, ast.stmt | ast.Subscript) and isinstance(value, ast.expr):
        return holds_table(value)
    if isinstance(node, ast.Call):
        arguments = [node.func, *node.args]
        return len(node.args) <= 2 and any(holds_table(argument) for argument in arguments)
    if isinstance(node, ast.Attribute):
        return holds_table(node.value)

    cells = _cells(node) if isinstance(node, ast.expr) else []
    rows = [row for row in cells if isinstance(row, ast.Tuple | ast.List)]
    is_matrix = len(rows) >= 2 and len(rows) == len(cells)
    table_rows = [_without_label(_cells(row)) for row in rows] if is_matrix else [cells]
    numbers = [number for row in table_rows for number in row]
    accepted = _is_arithmetic if is_matrix else _is_number
    if len(numbers) < TABLE_NUMBERS or not any(_is_number(number) for number in numbers):
        return False
    return all(accepted(number) for number in numbers)


def _cells(node: ast.expr) -> list[ast.expr]:
    if isinstance(node, ast.Dict):
        return node.values
    return node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else []


def _without_label(row: list[ast.expr]) -> list[ast.expr]:
    has_label = bool(row) and isinstance(row[0], ast.Constant) and isinstance(row[0].value, str)
    return row[1:] if has_label else row


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float | complex)


def _is_arithmetic(node: ast.expr) -> bool:
    allowed = (
        ast.Constant,
        ast.Name,
        ast.Attribute,
        ast.Subscript,
        ast.UnaryOp,
        ast.BinOp,
        ast.operator,
        ast.unaryop,
        ast.expr_context,
    )
    text = (
        isinstance(part, ast.Constant) and isinstance(part.value, str) for part in ast.walk(node)
    )
    return all(isinstance(part, allowed) for part in ast.walk(node)) and not any(text)


class Checker:
    """Runs ruff and the rules of this file over a checkout."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def check(self) -> list[Finding]:
        """Return the findings in all files."""
        findings = [*self._ruff_check(), *self._ruff_format()]
        for path in self._ruff("check", "--show-files", "."):
            name = (
                Path(path).relative_to(self.root).as_posix() if Path(path).is_absolute() else path
            )
            if name.endswith((".py", ".pyi")):
                try:
                    source = (self.root / name).read_text(encoding="utf-8")
                    findings += check_source(name, source)
                except (SyntaxError, UnicodeDecodeError):
                    continue  # ruff reports it
        return sorted(findings)

    def format(self) -> None:
        """Apply the fixes of ruff and format all files."""
        self._ruff("check", "--fix")
        self._ruff("format")

    def _ruff_check(self) -> Iterator[Finding]:
        for line in self._ruff("check", "--no-fix", "--output-format=concise"):
            if found := _RUFF_LINE.fullmatch(line):
                path = found["path"]
                yield Finding(path, int(found["line"]), found["rule"], found["text"].strip(" :"))

    def _ruff_format(self) -> Iterator[Finding]:
        for line in self._ruff("format", "--check", "--output-format=concise"):
            if (found := _RUFF_LINE.fullmatch(line)) and found["rule"] == "unformatted":
                text = "the layout is not that of the formatter"
                yield Finding(found["path"], int(found["line"]), "FMT", text)

    def _ruff(self, *arguments: str) -> list[str]:
        command = [sys.executable, "-m", "ruff", *arguments]
        done = subprocess.run(command, cwd=self.root, capture_output=True, text=True, check=False)
        if done.returncode > 1:
            sys.exit(f"{' '.join(command[1:5])}: {done.stderr.strip()}")
        return done.stdout.splitlines()


def advice(rules: set[str]) -> list[str]:
    """Return advice for the rules that were found."""
    return [
        f"  {start}: {text}"
        for start, text in ADVICE.items()
        if any(rule.startswith(start) and (start != "D" or rule[1:2].isdigit()) for rule in rules)
    ]


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(description="Check the style of the source files.")
    parser.add_argument("--format", action="store_true", help="format all files")
    options = parser.parse_args(arguments)
    checker = Checker(root)
    if options.format:
        checker.format()
        return 0

    findings = checker.check()
    for finding in findings:
        print(finding)
    if rows := advice({finding.rule for finding in findings}):
        print("What to write instead:")
        print("\n".join(rows))
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
