"""Widgets of the page that people change and that follow the session, and the page's style."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import viser

from robot_ik.testbed.commands import Command

Send = Callable[[Command], None]

STYLE = """<style>.rk{font:13px/1.45 system-ui,sans-serif;padding:0 .75em .5em}
.rk table{width:100%;border-collapse:collapse}
.rk td,.rk th{padding:3px 4px;text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.rk th{font-weight:500;opacity:.65;font-size:11.5px}.rk td:first-child,.rk th:first-child{text-align:left}
.rk tr+tr td{border-top:1px solid rgba(128,128,128,.25)}
.rk i{display:inline-block;width:10px;height:10px;border-radius:3px;margin-right:6px}
.rk i.dot{border-radius:5px}.rk small{opacity:.65}
.rk .bar{position:relative;height:6px;border-radius:3px;background:rgba(128,128,128,.28)}
.rk .bar b{position:absolute;top:-3px;width:4px;height:12px;border-radius:2px;margin-left:-2px}
.rk .w{width:55%}.rk .no{color:#dc2626;white-space:normal;text-align:left}
.rk kbd{font:600 11px system-ui;border:1px solid rgba(128,128,128,.5);border-radius:4px;padding:0 5px}
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
    """

    def __init__(self, handle: Any, act: Callable[[Any], None]) -> None:
        self.handle, self._touched = handle, -math.inf

        async def changed(event: Any) -> None:
            if event.client is not None:  # what the program sets has none
                self._touched = time.monotonic()
                act(event.target.value)

        handle.on_update(changed)

    @property
    def value(self) -> Any:
        """What it shows."""
        return self.handle.value

    def follow(self, value: Any) -> None:
        """Shows what the session has; not under the hand that moves it."""
        if time.monotonic() - self._touched > _HAND_SECONDS:
            self.handle.value = value


def pressed(button: Any, act: Callable[[Any], None]) -> None:
    """Calls ``act(event)`` when a person pressed the button."""

    async def clicked(event: Any) -> None:
        act(event)

    button.on_click(clicked)


def label_of(labels: Mapping[str, Any], value: Any) -> str:
    """The label of a value."""
    return next(label for label, one in labels.items() if one == value)


def is_usual(meta: Mapping[str, Any], value: Any) -> bool:
    """Whether an option stands first: it has a usual range, choices, or is yes or no."""
    return isinstance(value, bool) or bool(meta.get("choices")) or meta.get("usual") is not None


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
    low, high = meta["low"], meta["high"]
    text += f"; {low:g} … {high:g}"
    if meta.get("usual") is None:
        step = 1 if isinstance(value, int) else None
        return gui.add_number(label, value, min=low, max=high, step=step, hint=text)
    first, last = meta["usual"]
    if isinstance(value, int):
        return gui.add_slider(label, min(first, value), max(last, value), 1, value, hint=text)
    fine = 10.0 ** math.floor(math.log10((last - first) / 100.0))
    return gui.add_slider(label, min(first, value), max(last, value), fine, value, hint=text)
