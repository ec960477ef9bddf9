"""What stands on the page beside the scene: one class a panel, drawn from a ``View``.

A panel's callbacks only send commands.  They are ``async``, because viser keeps the order of events only
then; what the program itself sets calls them, too, with no client: that is not passed on.
"""

from __future__ import annotations

import dataclasses
import functools
import html
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import viser
from viser import uplot

from robot_ik import SOLVERS, catalogue
from robot_ik.motion.trajectory import Trajectory
from robot_ik.robot import Robot
from robot_ik.testbed import commands
from robot_ik.testbed.arrangement import INSTANCE_COLOURS, LIMIT_COLOUR, hexadecimal
from robot_ik.testbed.instance import InstanceView
from robot_ik.testbed.session import View

if TYPE_CHECKING:
    from robot_ik.testbed.arm import ArmLink, ArmView

Send = Callable[[commands.Command], None]

STYLE = """<style>.rk{font:13px/1.45 system-ui,sans-serif;padding:0 .75em .5em}
.rk table{width:100%;border-collapse:collapse}
.rk td,.rk th{padding:3px 4px;text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.rk th{font-weight:500;opacity:.65;font-size:11.5px}.rk td:first-child,.rk th:first-child{text-align:left}
.rk tr+tr td{border-top:1px solid rgba(128,128,128,.25)}
.rk i{display:inline-block;width:10px;height:10px;border-radius:3px;margin-right:6px}
.rk i.dot{border-radius:5px}.rk small{opacity:.65}
.rk .bar{position:relative;height:6px;border-radius:3px;background:rgba(128,128,128,.28)}
.rk .bar b{position:absolute;top:-3px;width:4px;height:12px;border-radius:2px;margin-left:-2px}
.rk .w{width:55%}.rk td.text,.rk .no{white-space:normal;text-align:left}.rk .no{color:#dc2626}
.rk kbd{font:600 11px system-ui;border:1px solid rgba(128,128,128,.5);border-radius:4px;padding:0 5px}
.rk .names{max-height:9em;overflow:auto;overflow-wrap:anywhere;font-size:11.5px}
[role="tab"]{padding-inline:8px!important}
@media(max-width:600px){[style*="max-height: 60%"]{width:100%!important;max-height:45%!important}
[style*="max-height: 60%"] [style*="width: 20em"]{width:100%!important}}</style>"""

_HAND_SECONDS = 1.5  # after a person changed a widget it does not follow for so long


def page(text: str) -> str:
    """HTML in the page's style; whoever calls this has escaped names and errors."""
    return f'{STYLE}<div class="rk">{text}</div>'


class Control:
    """A widget that people change and that follows the session.

    Args:
        handle: viser's.
        act: Called with the value when a person changed it.
        labels: What the options of a menu mean; None: themselves.
    """

    def __init__(
        self, handle: Any, act: Callable[[Any], None], labels: Mapping[str, Any] | None = None
    ) -> None:
        self.handle, self._touched = handle, -math.inf
        self._labels = {} if labels is None else {value: label for label, value in labels.items()}

        async def changed(event: Any) -> None:
            if event.client is not None:  # what the program sets has none
                self._touched = time.monotonic()
                act(event.target.value if labels is None else labels[event.target.value])

        handle.on_update(changed)

    @property
    def value(self) -> Any:
        """What it shows."""
        return self.handle.value

    def follow(self, value: Any, busy: str = "") -> None:
        """Shows what the session has; not under the hand that moves it, nor while that is still prepared."""
        if not busy and time.monotonic() - self._touched > _HAND_SECONDS:
            self.handle.value = self._labels.get(value, value)


def pressed(button: Any, act: Callable[[Any], None]) -> None:
    """Calls ``act(event)`` when a person pressed the button."""

    async def clicked(event: Any) -> None:
        act(event)

    button.on_click(clicked)


def option_widget(gui: viser.GuiApi, name: str, meta: Mapping[str, Any], value: Any) -> Any:
    """From a field's type and ranges: a box, a menu, a slider over its usual range, or a number."""
    label, unit = name.replace("_", " "), f" ({meta['unit']})" if meta["unit"] else ""
    text = f"{meta['help']}{unit}".replace("``", "")
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=text)
    if meta["choices"]:
        return gui.add_dropdown(label, meta["choices"], initial_value=value, hint=text)
    if isinstance(value, str):
        return gui.add_text(label, value, hint=text)
    low, high = meta["lower"], meta["upper"]
    text += f"; {low:g} … {high:g}"
    if meta.get("usual") is None:
        step = 1 if isinstance(value, int) else None
        return gui.add_number(label, value, min=low, max=high, step=step, hint=text)
    first, last = meta["usual"]
    if isinstance(value, int):
        return gui.add_slider(label, min(first, value), max(last, value), 1, value, hint=text)
    fine = 10.0 ** math.floor(math.log10((last - first) / 100.0))
    return gui.add_slider(label, min(first, value), max(last, value), fine, value, hint=text)


HINT = "Drag the orange ball, or any part of the robot."
FIGURE_HINT = "Drag the orange ball: the figure decides what to do."
LOST = "connection lost: STOP does not work"
"""What covers the page when its program does not answer."""
LOST_WITH_ARM = f"{LOST};\nuse robot-ik stop or the power switch"
STILL_ARM_HINT = "Press Start to go on. The arm stays until you press Follow."
STILL_HINT = "Press Start to go on."
_COUNT_LABELS = dict(zip(("one robot", "two methods", "four methods"), commands.COUNTS, strict=True))
_MOTION_LABELS = dict(zip(("on a curve", "at random places", "by hand"), commands.MOTIONS, strict=True))
_KINDS = ("pose", "position", "aim at the ball", "on a line", "on a plane")
_KIND_LABELS = dict(zip(_KINDS, commands.GOAL_KINDS, strict=True))
_ARM_LABELS = {
    "Follow": "follow", "Hold": "hold", "Torque off": "release", "Teach": "teach", "Replay": "replay",
}  # fmt: skip
_FIGURE_LABELS = {"its methods": "off", "itself, following": "active", "itself, on demand": "passive"}
LIMP = "The arm is limp: the torque is off, and nothing holds it. Press Follow to switch the torque on."
LIMP_TEACH = "The arm is limp: guide it by hand. Hold ends the recording; the arm stays limp."
_STATE_DOTS = {"running": "#16a34a", "holding still": "#dc2626"}
_INK = "#808a97"  # of axes: readable on light and dark
_ERROR_RANGE = (1e-3, 1e3)  # mm, degrees: an axis that fits itself jumps
_DECADES = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)  # its ticks: those between become grey blocks
_JOINTS_SHOWN = 8
_STOP_HEIGHT = 52  # px


class ConnectionPanel:
    """What ``connection.js`` watches in the browser; it shows nothing itself."""

    def __init__(self, gui: viser.GuiApi, with_arm: bool) -> None:
        self._lost = LOST_WITH_ARM if with_arm else LOST
        self._beats = 0
        self._element = gui.add_html("")
        self.show()

    def show(self) -> None:
        """One beat; to be called once a second."""
        self._beats += 1
        self._element.content = (
            f'<i hidden data-beat="{self._beats}" data-lost="{html.escape(self._lost)}"></i>'
        )


class RunPanel:
    """State, STOP, and what the ball and the robots do."""

    def __init__(self, gui: viser.GuiApi, send: Send, view: View) -> None:
        # STOP comes first: what stands above it would move it whenever its number of lines changes.
        stop = gui.add_button("STOP", color="red", icon=viser.Icon.HAND_STOP, hint="Everything holds still")
        pressed(stop, lambda _: send(commands.SetRunning(False)))
        self.stop_uuid: str = stop._impl.uuid
        size = f"height:{_STOP_HEIGHT}px!important;font:700 20px system-ui;letter-spacing:.12em"
        button = f'[id="{self.stop_uuid}"]'
        # It stays in place while the panel scrolls; one of viser's boxes round it clips, and would scroll it.
        stays = f"div:has(>{button}){{position:sticky;top:9px;z-index:9}}"
        stays += f"div:has(>div>div>div>{button}){{overflow:visible!important}}"
        self._style = f"<style>{button}{{{size}}}{button} svg{{margin-right:.5em}}{stays}</style>"
        self._state = gui.add_html(self._style + page(HINT))
        run = gui.add_button_group(
            "Run", ("Start", "Pause", "Reset"), hint="Space starts and pauses; R resets"
        )
        actions = {
            "Start": commands.SetRunning(True),
            "Pause": commands.SetRunning(False),
            "Reset": commands.Reset(),
        }
        pressed(run, lambda event: send(actions[event.target.value]))
        names = tuple(dict.fromkeys((*catalogue(), view.robot)))
        self._robot = Control(
            gui.add_dropdown("Robot", names, initial_value=view.robot, hint="Any robot that ships"),
            lambda value: send(commands.SetRobot(value)),
        )
        self._missing = gui.add_html("", visible=False)
        with gui.add_folder("A model of your own", expand_by_default=False):
            path = gui.add_text(
                "Path", "", hint="An MJCF or URDF file, on the machine where this program runs"
            )
            load = gui.add_button("Load", icon=viser.Icon.FOLDER_OPEN, hint="In place of the robot")
        pressed(load, lambda _: send(commands.SetRobot(path.value.strip())))
        self._count = Control(
            gui.add_dropdown("Compare", tuple(_COUNT_LABELS), hint="Side by side (keys 1, 2, 4)"),
            lambda count: send(commands.SetCount(count)), _COUNT_LABELS,
        )  # fmt: skip
        self._motion = Control(
            gui.add_dropdown("Ball", tuple(_MOTION_LABELS), hint="How the ball moves (I)"),
            lambda motion: send(commands.SetMotion(motion)), _MOTION_LABELS,
        )  # fmt: skip
        self._speed = Control(
            gui.add_slider("Speed", 0.0, 3.0, 0.05, view.speed, hint="Of the ball; 1 is real time"),
            lambda value: send(commands.SetSpeed(float(value))),
        )

    def show(self, view: View) -> None:
        """State line and menus, five times a second."""
        dot = _STATE_DOTS.get(view.state, "#f58220")
        hint = HINT if view.figure is None else FIGURE_HINT
        if not view.running:
            hint = STILL_HINT if view.arm is None else STILL_ARM_HINT
        line = html.escape(view.busy or view.message or hint)
        text = f'<i class="dot" style="background:{dot}"></i><b>{html.escape(view.state)}</b><br>{line}'
        self._state.content = self._style + page(text)
        self._motion.follow(view.motion)
        if view.robot not in self._robot.handle.options:  # one of somebody's own
            self._robot.handle.options = (*self._robot.handle.options, view.robot)
        self._robot.follow(view.robot, view.busy)
        self._missing.visible = bool(view.missing_meshes)
        self._missing.content = page(missing_text(view.missing_meshes))
        self._count.follow(view.count, view.busy)
        self._speed.follow(view.speed)


def missing_text(names: Sequence[str]) -> str:
    """Which mesh files of the robot are not drawn, by the names that its file gives them; HTML."""
    if not names:
        return ""
    meshes = "1 mesh is" if len(names) == 1 else f"{len(names)} meshes are"
    rows = "<br>".join(html.escape(name) for name in names)
    return (
        f'<span class="no">{meshes} not drawn: no such file, or neither STL nor OBJ. The kinematics is '
        f'complete.</span><div class="names">{rows}</div>'
    )


class MethodPanel:
    """A folder for each instance: its method, and that method's options made from the solver's fields."""

    def __init__(self, gui: viser.GuiApi, send: Send) -> None:
        self._limits = Control(
            gui.add_checkbox("Joint limits", True, hint="Whether they hold (O)"),
            lambda value: send(commands.SetLimits(value)),
        )
        # Made once for four and hidden: widgets that come and go trouble a slow browser.
        self._folders = [_MethodFolder(gui, send, k) for k in range(4)]

    def show(self, view: View) -> None:
        """Follows the session."""
        self._limits.follow(view.limits, view.busy)
        for k, folder in enumerate(self._folders):
            folder.show(view.instances[k] if k < view.count else None, view.count, view.busy)


class _MethodFolder:
    """Method and options of one instance."""

    def __init__(self, gui: viser.GuiApi, send: Send, k: int) -> None:
        self._gui, self._send, self._k = gui, send, k
        self._shown = ""
        self._widgets: dict[str, Control] = {}
        self._folder = gui.add_folder(f"Robot {k + 1}", visible=False)
        with self._folder:
            self._colour = gui.add_html("", visible=False)
            menu = gui.add_dropdown("Method", tuple(SOLVERS), hint="robot-ik solvers says what each is")
            self._options = gui.add_folder("Options", expand_by_default=k == 0)
        self._menu = Control(menu, lambda value: send(commands.SetMethod(k, value)))

    def show(self, one: InstanceView | None, count: int, busy: str) -> None:
        """Follows the instance, once it has a method; None: there is none."""
        self._folder.visible = one is not None and one.method != ""
        if one is None or not one.method:
            return
        colour = hexadecimal(INSTANCE_COLOURS[self._k])
        bar = f'<div style="height:4px;border-radius:2px;background:{colour}"></div>'
        self._colour.content, self._colour.visible = bar, count > 1
        if self._shown != one.method:
            self._shown = one.method
            self._rebuild(one)
        self._menu.follow(one.method, busy)
        for name, value in one.options:
            if name in self._widgets:
                self._widgets[name].follow(value, busy)

    def _rebuild(self, one: InstanceView) -> None:
        for child in list(self._options._children.values()):
            child.remove()
        self._widgets = {}
        fields, values = dataclasses.fields(SOLVERS[one.method]), dict(one.options)
        # First what has a usual range or choices, or is yes or no.
        usual = [
            field for field in fields
            if isinstance(values[field.name], bool) or field.metadata.get("choices")
            or field.metadata.get("usual") is not None
        ]  # fmt: skip
        rare = [field for field in fields if field not in usual]
        with self._options:
            for field in usual:
                self._add(field, values[field.name])
            if not fields:
                self._gui.add_html(page("<small>a closed form: nothing to set</small>"))
            if rare:
                with self._gui.add_folder("More", expand_by_default=not usual):
                    for field in rare:
                        self._add(field, values[field.name])

    def _add(self, field: Any, value: Any) -> None:
        widget = option_widget(self._gui, field.name, field.metadata, value)
        low = field.metadata.get("lower")

        def changed(chosen: Any) -> None:
            if isinstance(chosen, float) and low is not None:
                chosen = max(chosen, low)  # a slider from 0, where 0 itself is not allowed
            self._send(commands.SetOption(self._k, field.name, chosen))

        self._widgets[field.name] = Control(widget, changed)


class GoalsPanel:
    """What the ball asks of the tool, goals beside it with their priorities, branches to pick from."""

    def __init__(self, gui: viser.GuiApi, send: Send) -> None:
        self._gui, self._send = gui, send
        self._kind = Control(
            gui.add_dropdown("Ball asks", tuple(_KIND_LABELS), hint="Of the tool (K)"),
            lambda kind: send(commands.SetGoalKind(kind)), _KIND_LABELS,
        )  # fmt: skip
        self._branches = Control(
            gui.add_checkbox("Branches", False, hint="All ways of a closed form, as ghosts (B)"),
            lambda value: send(commands.ShowBranches(value)),
        )
        self._pick = Control(
            gui.add_dropdown("Go on from", ("–",), visible=False, hint="A branch for robot 1"), self._picked
        )
        gui.add_html(page("<small>goals and their priorities: 0 is served first</small>"))
        self._folder = gui.add_folder(None)
        self._errors = gui.add_html("")
        self._rows: dict[str, tuple[Control | None, Control]] = {}

    def _picked(self, value: str) -> None:
        if value in self._pick.handle.options[1:]:
            self._send(commands.PickBranch(self._pick.handle.options.index(value) - 1))

    def show(self, view: View) -> None:
        """Follows the session."""
        self._kind.follow(view.kind, view.busy)
        self._branches.follow(view.show_branches, view.busy)
        names = ("–", *(branch.name for branch in view.branches))
        self._pick.handle.visible = view.show_branches
        if self._pick.handle.options != names:
            self._pick.handle.options = names
            self._pick.handle.value = "–"
        if list(self._rows) != [extra.name for extra in view.extras]:
            self._rebuild(view)
        for extra in view.extras:
            box, rank = self._rows[extra.name]
            if box is not None:
                box.follow(extra.on, view.busy)
            rank.follow(extra.priority, view.busy)
        rows = [
            (html.escape(name), f"{1e3 * metres:.2f}", f"{math.degrees(angle):.2f}")
            for name, metres, angle in view.instances[0].goals
        ]
        self._errors.content = page(_table(("robot 1 is off by", "mm", "°"), rows) if rows else "")

    def _rebuild(self, view: View) -> None:
        for child in list(self._folder._children.values()):
            child.remove()
        self._rows = {}
        with self._folder:
            for extra in view.extras:
                name = extra.name
                changed = functools.partial(self._changed, name)
                box = None
                if name != "ball":
                    box = Control(self._gui.add_checkbox(name, extra.on, hint=extra.about), changed)
                label = "ball's priority" if name == "ball" else "priority"
                rank = self._gui.add_slider(label, 0, 9, 1, extra.priority, hint="0 is served first")
                self._rows[name] = box, Control(rank, changed)

    def _changed(self, name: str, value: object) -> None:
        box, rank = self._rows[name]
        self._send(commands.SetExtraGoal(name, True if box is None else bool(box.value), int(rank.value)))


class FigurePanel:
    """A figure that decides by itself: who moves it, what it decided, and why."""

    def __init__(self, gui: viser.GuiApi, send: Send, view: View) -> None:
        self._mode = Control(
            gui.add_dropdown(
                "Moved by", tuple(_FIGURE_LABELS), visible=view.can_act,
                hint="Following: it acts whenever the ball moves. On demand: on the ball as it is then",
            ),
            lambda mode: send(commands.SetFigure(mode)), _FIGURE_LABELS,
        )  # fmt: skip
        self._act = gui.add_button(
            "Act now", icon=viser.Icon.RUN, visible=False, hint="On the ball where it is; it then stays there"
        )
        pressed(self._act, lambda _: send(commands.Act()))
        self._text = gui.add_html("")

    def show(self, view: View) -> None:
        """Decision, reason, and what it does now."""
        acting = view.figure
        self._mode.handle.visible = view.can_act
        self._mode.follow("off" if acting is None else acting.mode, view.busy)
        self._act.visible = acting is not None and acting.mode == "passive"
        self._text.content = page(self._figure_text(view))

    @staticmethod
    def _figure_text(view: View) -> str:
        acting = view.figure
        if not view.can_act:
            return "<small>this robot is no figure: choose humanoid under Robot</small>"
        if acting is None:
            does = "the figure reaches, bends, jumps or walks to the ball by itself, if it is let"
            return f"<small>{does}</small>"
        if acting.waiting:
            return "<b>waits</b><br><small>drag the ball, then press Act now</small>"
        decision = acting.decision
        does = f"<b>{decision.action}</b>" + (f", then {decision.then}" if decision.then else "")
        arm = f" with the {decision.arm} hand" if decision.arm else ""
        share = round(100.0 * acting.phase)
        colour = hexadecimal(INSTANCE_COLOURS[0])
        bar = f'<div class="bar"><b style="left:{share}%;background:{colour}"></b></div>'
        return f"{does}{arm}<br>{html.escape(decision.reason)}<br><small>now: {acting.action}</small>{bar}"


class ArmPanel:
    """The servo arm that the first instance drives."""

    def __init__(self, gui: viser.GuiApi, send: Send, arm: ArmLink | None) -> None:
        self._text, there = gui.add_html(""), arm is not None
        labels = tuple(_ARM_LABELS)
        for label, buttons, hint in (
            ("Arm", labels[:3], "Follow robot 1; hold; torque off: an arm that is not supported falls"),
            ("By hand", labels[3:], "Teach: torque off, and a hand is recorded; Replay repeats it"),
        ):
            group = gui.add_button_group(label, buttons, visible=there, hint=hint)
            pressed(group, lambda event: send(commands.SetArm(_ARM_LABELS[event.target.value])))  # type: ignore[arg-type]
        save = gui.add_button(
            "Save the recording", icon=viser.Icon.DOWNLOAD, visible=there,
            hint="As CSV: robot-ik servo play repeats it, too",
        )  # fmt: skip
        pressed(save, lambda event: self._save(event, None if arm is None else arm.recording))
        self._table = gui.add_html("", visible=there)

    @staticmethod
    def _save(event: Any, shown: Trajectory | None) -> None:
        if event.client is None:
            return
        if shown is None:
            event.client.add_notification(
                "Nothing is recorded yet", "Press Teach, guide the arm, press Hold; then save.",
                auto_close_seconds=4.0,
            )  # fmt: skip
        else:
            event.client.send_file_download("recording.csv", shown.csv_text().encode())

    def show(self, view: View) -> None:
        """State, torque, currents, temperatures."""
        arm = view.arm
        if arm is None:
            line = "<small>no arm: start with <kbd>robot-ik view --bus sim</kbd></small>"
            self._text.content = page(line)
            return
        limp = f'<span class="no"><b>{_limp_text(arm)}</b></span><br>' if arm.limp else ""
        where = f"yellow ghost: where it is; {math.degrees(arm.apart):.1f}° behind"
        if not arm.is_shown:
            where = f"the arm is a {html.escape(arm.robot.name)}, another robot than the one on the page"
        asked = "" if arm.limp and arm.mode == "hold" else f"; asked: {arm.mode}"
        said = f'<br><span class="no">{html.escape(arm.message)}</span>' if arm.message else ""
        self._text.content = page(
            f"<b>{html.escape(arm.state)}</b> on {html.escape(arm.port)}{asked}<br>"
            f"{limp}<small>{where}; recorded: {arm.recorded:.1f} s</small>{said}"
        )
        rows = []
        for s in arm.servos:
            at = _cell(s.position_deg, 1, "°") if s.position_mm is None else _cell(s.position_mm, 1, " mm")
            torque, errors = "on" if s.torque else "off", html.escape(", ".join(s.errors))
            cells = (at, torque, _cell(s.current_ma), _cell(s.temperature), errors)
            rows.append((html.escape(s.joint), *cells))
        self._table.content = page(_table(("joint", "at", "torque", "mA", "°C", "errors"), rows))


def _limp_text(arm: ArmView) -> str:
    """That nothing holds the arm, and what to press."""
    return LIMP_TEACH if arm.mode == "teach" else LIMP


def _cell(value: float | None, digits: int = 0, unit: str = "") -> str:
    return "–" if value is None else f"{value:z.{digits}f}{unit}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Of cells that are HTML already."""
    head = "".join(f"<th>{label}</th>" for label in heads)
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


class MeasuredPanel:
    """Statistics, one plot with a menu, joints against their limits."""

    # Column of the history, and by what it is multiplied for a logarithmic axis; 0: a linear one.
    _PLOTS: Mapping[str, tuple[int, float]] = {
        "distance to the goal, mm": (0, 1e3),
        "angle to the goal, °": (1, math.degrees(1.0)),
        "manipulability": (2, 0.0),
    }

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")
        self._menu = gui.add_dropdown("Plot", tuple(self._PLOTS), hint="Over the last 5 seconds")
        # Made once for every number of robots and hidden, as the folders of the methods.
        self._plots = {(n, name): self._plot(gui, n, name) for n in commands.COUNTS for name in self._PLOTS}
        self._joints = gui.add_html("")

    def _plot(self, gui: viser.GuiApi, n: int, name: str) -> Any:
        lines: Any = [
            {"label": f"{k + 1}", "stroke": hexadecimal(colour), "width": 1.5}
            for k, colour in zip(range(n), INSTANCE_COLOURS, strict=False)
        ]
        axis: Any = {
            "stroke": _INK, "grid": {"stroke": _INK + "30", "width": 1}, "ticks": {"stroke": _INK + "50"},
            "font": "11px system-ui",
        }  # fmt: skip
        scale: Any = {"distr": 3, "range": _ERROR_RANGE} if self._PLOTS[name][1] else {"range": (0.0, 1.0)}
        decades: Any = {"splits": _DECADES} if self._PLOTS[name][1] else {}
        return gui.add_uplot(
            (np.linspace(0.0, 1.0, 2), *(np.ones(2) for _ in range(n))), ({"label": "s"}, *lines),
            height=190, title=f"{name}, over seconds", scales={"x": {"time": False}, "y": scale},
            axes=(axis, axis | {"size": 56} | decades), legend=uplot.Legend(show=False),
            cursor=uplot.Cursor(show=False), padding=(12, 14, 0, 0), visible=False,
        )  # fmt: skip

    def show(self, view: View) -> None:
        """The table, once a second."""
        acting = int(view.figure is not None)  # the first robot then, and it has no method
        rows = "".join(self._row(k, one, k < acting) for k, one in enumerate(view.instances))
        head = "<tr><th>method</th><th>µs</th><th>p99</th><th>steps</th><th>solved</th><th>off by</th></tr>"
        note = "the figure decides by itself: no method is measured"
        if counts := [one.statistics.count for one in view.instances[acting:]]:
            last = f"the last {max(counts)} solves" if any(counts) else "nothing solved yet"
            note = f"in this page, {last}; for comparable times: robot-ik bench"
        self._table.content = page(f"<table>{head}{rows}</table><small>{note}</small>")

    @staticmethod
    def _row(k: int, one: InstanceView, acting: bool) -> str:
        colour, name = hexadecimal(INSTANCE_COLOURS[k]), html.escape(one.method or "…")
        name, note = ("itself", "") if acting else (name, one.note)
        ended = html.escape(one.status if one.able else "") or "–"
        first = f'<td title="{html.escape(note)}"><i style="background:{colour}"></i>{name}'
        first += f"<br><small>{ended}</small></td>"
        if not one.able and not acting:
            return f'<tr>{first}<td colspan="5" class="no">{html.escape(one.status)}</td></tr>'
        if acting or not one.statistics.count:
            return f"<tr>{first}{4 * '<td>–</td>'}<td>{one.off if acting else '–'}</td></tr>"
        s = one.statistics
        times = "".join(f"<td>{1e6 * t:.{0 if t > 1e-4 else 1}f}</td>" for t in (s.mean, s.p99))
        return (
            f"<tr>{first}{times}<td>{s.iterations:.1f}</td><td>{100.0 * s.solved:.0f} %</td>"
            f"<td>{one.off}</td></tr>"
        )

    def draw(self, view: View, robot: Robot) -> None:
        """Plot and joints, five times a second."""
        for (n, name), plot in self._plots.items():
            visible = (n, name) == (view.count, self._menu.value) and view.tick > 1
            plot.visible = visible
            if visible:
                self._fill(plot, view, name)
        self._joints.content = page(joint_bars(view, robot))

    def _fill(self, plot: Any, view: View, name: str) -> None:
        column, factor = self._PLOTS[name]
        n = min(len(one.errors) for one in view.instances)
        if n < 2:
            return
        times = (np.arange(n) - n + 1.0)[::3] * (view.now / max(view.tick, 1))
        rows = [one.errors[-n:, column][::3] for one in view.instances]
        if factor:
            rows = [np.clip(factor * row, 1.5 * _ERROR_RANGE[0], _ERROR_RANGE[1]) for row in rows]
        else:
            top = 1.1 * max(1e-6, *(float(row.max()) for row in rows))
            if not 0.5 * plot.scales["y"]["range"][1] <= top <= plot.scales["y"]["range"][1]:
                plot.scales = {"x": {"time": False}, "y": {"range": (0.0, 1.3 * top)}}
        data = (times, *rows)
        if not (len(plot.data) == len(data) and all(map(np.array_equal, plot.data, data))):
            plot.data = data  # viser compares single arrays only: a page at rest would send this for ever


def joint_bars(view: View, robot: Robot) -> str:
    """Joints against their limits: a bar each; of many the ones that are nearest to a limit."""
    model = robot.model
    active = [model.joint(name).id for name in robot.joints]
    ids = [i for i in active if model.jnt_limited[i] and model.jnt_type[i] in (_HINGE, _SLIDE)]
    if not ids:
        return "<small>no joint has limits</small>"
    low, high = model.jnt_range[ids].T
    angles = np.array([robot.qpos(one.q)[model.jnt_qposadr[ids]] for one in view.instances])
    shares = np.clip((angles - low) / (high - low), 0.0, 1.0)
    order: Sequence[int] = range(len(ids))
    if len(ids) > _JOINTS_SHOWN:
        order = np.argsort(np.minimum(shares, 1.0 - shares).min(axis=0))[:_JOINTS_SHOWN].tolist()
    rows = ""
    for i in order:
        marks = "".join(_mark(k, share) for k, share in enumerate(shares[:, i].tolist()))
        angle = model.jnt_type[ids[i]] == _HINGE
        value = f"{np.degrees(angles[0, i]):z.1f}°" if angle else f"{1e3 * angles[0, i]:z.0f} mm"
        name = html.escape(model.joint(ids[i]).name)
        rows += f'<tr><td>{name}</td><td class="w"><div class="bar">{marks}</div></td><td>{value}</td></tr>'
    head = "joint" if len(ids) <= _JOINTS_SHOWN else f"nearest to a limit, of {len(ids)}"
    return f"<table><tr><th>{head}</th><th>lower … upper</th><th></th></tr>{rows}</table>"


_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def _mark(k: int, share: float) -> str:
    at_limit = share < 1e-6 or share > 1.0 - 1e-6
    colour = hexadecimal(LIMIT_COLOUR if at_limit else INSTANCE_COLOURS[k])
    return f'<b style="left:{100.0 * share:.1f}%;background:{colour}"></b>'


def key_table() -> str:
    """The page's keys, from ``KEYMAP``."""
    keys = [(key.browser, html.escape(key.about)) for key in commands.KEYMAP if key.browser]
    rows = (f'<tr><td><kbd>{key}</kbd></td><td class="text">{about}</td></tr>' for key, about in keys)
    return page(f"<table>{''.join(rows)}</table>")
