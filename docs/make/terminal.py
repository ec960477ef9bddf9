"""Draw the output of commands as pictures of a terminal, in SVG."""

from __future__ import annotations

import html
import re

#: Font size of the text, px. One character is this wide, in font sizes.
FONT_SIZE = 14.0
CHARACTER_WIDTH = 0.602
#: Distance of two lines and the border around the text, px.
LINE_HEIGHT = 20.0
BORDER = 16.0
#: Height of the bar with the three dots, px.
BAR_HEIGHT = 30.0

BACKGROUND = "#1e2430"
BAR = "#2b3342"
TEXT = "#e6e9ef"
PROMPT = "#7cc4ff"
DOTS = ("#ff6058", "#ffbd2e", "#28c940")
FONTS = "ui-monospace,SFMono-Regular,Menlo,Consolas,DejaVu Sans Mono,monospace"

NO_BREAK_SPACE = "\N{NO-BREAK SPACE}"
_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def terminal_svg(command: str, output: str, label: str) -> str:
    """Return a picture of a terminal with a command and its output.

    Args:
        command: The line after the prompt.
        output: Text that the command printed. Escape sequences are removed.
        label: Description of the picture for screen readers.
    """
    printed = _ESCAPE.sub("", output).rstrip().splitlines()
    lines = [f"$ {command}", *(line.rstrip() for line in printed)]
    advance = FONT_SIZE * CHARACTER_WIDTH
    width = round(max(len(line) for line in lines) * advance + 2 * BORDER)
    height = round(BAR_HEIGHT + 2 * BORDER + LINE_HEIGHT * len(lines) - 4)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(label)}">',
        f'<rect width="{width}" height="{height}" rx="9" fill="{BACKGROUND}"/>',
        f'<path d="M0 {BAR_HEIGHT}V9a9 9 0 0 1 9-9h{width - 18}a9 9 0 0 1 9 9v{BAR_HEIGHT - 9}z" '
        f'fill="{BAR}"/>',
    ]
    parts += [
        f'<circle cx="{20 + 20 * k}" cy="{BAR_HEIGHT / 2}" r="5.5" fill="{colour}"/>'
        for k, colour in enumerate(DOTS)
    ]
    parts.append(f'<g font-family="{FONTS}" font-size="{FONT_SIZE}" xml:space="preserve">')
    for row, line in enumerate(lines):
        if not line:
            continue
        y = BAR_HEIGHT + BORDER + LINE_HEIGHT * row + FONT_SIZE - 2
        colour = PROMPT if row == 0 else TEXT
        # Browsers merge spaces. The font of the viewer may be wider, and textLength corrects it.
        text = html.escape(line).replace(" ", NO_BREAK_SPACE)
        parts.append(
            f'<text x="{BORDER:g}" y="{y:g}" fill="{colour}" '
            f'textLength="{len(line) * advance:.1f}" '
            f'lengthAdjust="spacingAndGlyphs">{text}</text>'
        )
    return "\n".join([*parts, "</g>", "</svg>", ""])
