"""Texts about ball, mode and decision, for the camera's picture and for MuJoCo's window."""

from __future__ import annotations

from robot_ik.testbed.view import FigureView, View


def mode_text(view: View) -> str:
    """Return the mode of the figure, or the state of the method without a figure."""
    figure = view.figure
    if figure is None:
        one = view.instances[0]
        return f"{one.method}: {one.words}" if one.method else view.state
    if figure.locked:
        return "passive: the ball is locked; I or R frees it"
    if figure.waiting:
        return "passive: move the ball, Space starts"
    return "active: the figure follows the ball"


def decision_text(figure: FigureView) -> str:
    """Return the decision, with its reason."""
    if figure.waiting:
        return "waits for Space"
    decision = figure.decision
    then = f", then {decision.then}" if decision.then else ""
    arm = f" with the {decision.arm} hand" if decision.arm else ""
    return f"{decision.action}{then}{arm}: {decision.reason}"


def ball_text(view: View) -> str:
    """Return the position of the ball in metres, world."""
    x, y, z = (float(value) for value in view.ball.position)
    return f"x {x:+.2f}  y {y:+.2f}  z {z:+.2f} m"


def caption_lines(view: View) -> list[str]:
    """Return the lines that are written into a picture: ball, mode, decision, message."""
    lines = [f"ball {ball_text(view)}", mode_text(view)]
    if view.figure is not None:
        lines.append(decision_text(view.figure))
    if view.message:
        lines.append(view.message)
    return lines
