"""Errors of files, settings, optional packages and windows."""

from __future__ import annotations

from pathlib import Path

from robot_ik.errors.base import RobotIkError


class ConfigError(RobotIkError, ValueError):
    """A configuration file is wrong.

    Attributes:
        file: The file.
        key: Dotted key, or empty when the whole file is meant.
        allowed: What would be right, in words.
    """

    def __init__(
        self, problem: str, *, file: Path | str, key: str = "", allowed: str = "", hint: str = ""
    ) -> None:
        self.file = file
        self.key = key
        self.allowed = allowed
        where = f"{file}: {key}: " if key else f"{file}: "
        super().__init__(
            where + problem + (f"; allowed: {allowed}" if allowed else ""),
            hint=hint,
        )


class MissingExtraError(RobotIkError, ImportError):
    """An optional package is not installed; the message is the command that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self.package = package
        self.extra = extra
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed",
            hint=f'install it with: pip install "robot_ik[{extra}]"',
        )


class ViewerError(RobotIkError):
    """A window cannot be opened; the hint says what to run instead."""


class OutputError(RobotIkError, OSError):
    """A result cannot be written where it was asked for."""
