// A plot of the last seconds: a legend, an axis that fits its lines, values under the mouse.

import { make } from "./dom.js";

const SECONDS = 8;
const MARGIN = { left: 44, right: 10, top: 10, bottom: 20 };
const TICKS_IN_SECONDS = [6, 4, 2, 0];
const SMALLEST = 1e-4; // of a logarithmic axis
const MOST_TICKS = 6;
const LINEAR_ROOM = 1.15; // of a linear axis above its highest line

/** What can be plotted: field of an instance, unit, kind of the axis, digits in the legend. */
export const QUANTITIES = {
  error_mm: { label: "Distance to the ball", unit: "mm", linear: false, digits: 2 },
  angle_deg: { label: "Angle to the ball", unit: "°", linear: false, digits: 2 },
  iterations: { label: "Iterations", unit: "steps", linear: true, digits: 0, top: 5 },
  manipulability: { label: "Manipulability", unit: "", linear: true, digits: 3, top: 0.01 },
};

export class Plot {
  constructor(colours) {
    this.colours = colours;
    this.rows = []; // time and instances of each view
    this.name = "error_mm";
    this.hidden = new Set();
    this.range = null;
    this.legend = make("div", { class: "rk-legend num" });
    this.entries = colours.map((colour, k) => this.entry(colour, k));
    this.legend.append(...this.entries.map(({ element }) => element));
    this.canvas = make("canvas", { role: "img", "aria-label": "plot of the last seconds" });
    this.element = make("div", { class: "rk-plot" }, this.legend, this.canvas);
    this.canvas.addEventListener("pointermove", (event) => {
      this.mouse = event.offsetX;
      this.draw();
    });
    this.canvas.addEventListener("pointerleave", () => {
      this.mouse = null;
      this.draw();
    });
  }

  get quantity() {
    return QUANTITIES[this.name];
  }

  entry(colour, k) {
    const text = make("span");
    const element = make(
      "button",
      {
        type: "button",
        style: `--c:${colour}`,
        title: "Show or hide this line",
        onclick: () => {
          if (!this.hidden.delete(k)) this.hidden.add(k);
          this.draw();
        },
      },
      make("i"),
      text,
    );
    return { element, text };
  }

  choose(name) {
    this.name = name;
    this.range = null;
    this.draw();
  }

  add(view) {
    const last = this.rows.at(-1);
    const restarted = last && (view.now < last.now || last.all.length !== view.instances.length);
    if (restarted) this.rows = [];
    if (view.now !== this.rows.at(-1)?.now) {
      this.rows.push({ now: view.now, all: view.instances });
    }
    while (this.rows.length && this.rows[0].now < view.now - SECONDS) this.rows.shift();
  }

  /** Choose a range that contains all lines. It changes only if it is much too large or too small. */
  fit(values) {
    const shown = values.filter((value) => value > 0);
    if (this.quantity.linear) {
      const top = Math.max(this.quantity.top, ...shown) * LINEAR_ROOM;
      const isUnfit = !this.range || top > this.range[1] || top < 0.4 * this.range[1];
      if (isUnfit) this.range = [0, top];
      return;
    }
    const smallest = shown.length ? Math.min(...shown, 1) : SMALLEST;
    const low = Math.floor(Math.log10(Math.max(SMALLEST, smallest)));
    const high = Math.max(Math.ceil(Math.log10(Math.max(...shown, 1e-3)) + 1e-9), low + 2);
    const kept =
      this.range &&
      low >= this.range[0] &&
      high <= this.range[1] &&
      high >= this.range[1] - 1 &&
      low <= this.range[0] + 1;
    if (!kept) this.range = [low, high];
  }

  draw() {
    const { canvas, rows } = this;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (!width) return;
    const ratio = devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const count = rows.at(-1)?.all.length ?? 0;
    const lines = [...Array(count).keys()].filter((k) => !this.hidden.has(k));
    this.fit(rows.flatMap(({ all }) => lines.map((k) => all[k][this.name])));

    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui";
    this.x = (time) => {
      const span = width - MARGIN.left - MARGIN.right;
      return MARGIN.left + span * (1 + (time - (rows.at(-1)?.now ?? 0)) / SECONDS);
    };
    const [low, high] = this.range;
    this.y = (value) => {
      const share = this.quantity.linear
        ? value / high
        : (Math.log10(Math.max(value, 10 ** low)) - low) / (high - low);
      const span = height - MARGIN.top - MARGIN.bottom;
      return height - MARGIN.bottom - span * Math.min(1, share);
    };
    this.drawAxes(context, width, height);
    this.drawLines(context, lines);
    this.drawCursor(context, height);
  }

  ticks() {
    const [low, high] = this.range;
    if (this.quantity.linear) return [0, high / 2, high];
    const all = Array.from({ length: high - low + 1 }, (_, k) => 10 ** (low + k));
    return all.length > MOST_TICKS ? all.filter((_, k) => k % 2 === 0) : all;
  }

  drawAxes(context, width, height) {
    const style = getComputedStyle(document.documentElement);
    context.strokeStyle = style.getPropertyValue("--line");
    context.fillStyle = style.getPropertyValue("--faint");
    context.lineWidth = 1;
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const tick of this.ticks()) {
      context.beginPath();
      context.moveTo(MARGIN.left, this.y(tick));
      context.lineTo(width - MARGIN.right, this.y(tick));
      context.stroke();
      const text = tick >= 1 || tick === 0 ? tick.toFixed(0) : String(+tick.toPrecision(1));
      context.fillText(text, MARGIN.left - 6, this.y(tick));
    }
    context.textAlign = "center";
    context.textBaseline = "alphabetic";
    const now = this.rows.at(-1)?.now ?? 0;
    for (const back of TICKS_IN_SECONDS) {
      const text = back ? `-${back} s` : "now";
      context.fillText(text, Math.min(width - 16, this.x(now - back)), height - 5);
    }
  }

  drawLines(context, lines) {
    context.lineWidth = 1.8;
    context.lineJoin = "round";
    for (const k of lines) {
      context.strokeStyle = this.colours[k];
      context.beginPath();
      this.rows.forEach(({ now, all }, i) => {
        const point = [this.x(now), this.y(all[k][this.name])];
        if (i) context.lineTo(...point);
        else context.moveTo(...point);
      });
      context.stroke();
    }
  }

  /** The values under the mouse, or the latest. */
  drawCursor(context, height) {
    let row = this.rows.at(-1);
    if (this.mouse != null && row) {
      const distance = ({ now }) => Math.abs(this.x(now) - this.mouse);
      row = this.rows.reduce((best, one) => (distance(one) < distance(best) ? one : best));
      context.lineWidth = 1;
      context.strokeStyle = context.fillStyle;
      context.setLineDash([3, 3]);
      context.beginPath();
      context.moveTo(this.x(row.now), MARGIN.top);
      context.lineTo(this.x(row.now), height - MARGIN.bottom);
      context.stroke();
      context.setLineDash([]);
    }
    const { unit, digits } = this.quantity;
    this.entries.forEach(({ element, text }, k) => {
      const one = row?.all[k];
      element.classList.toggle("rk-hidden", !one);
      element.classList.toggle("off", this.hidden.has(k));
      const value = one?.[this.name];
      if (one) text.textContent = `${one.method || "…"} ${(value ?? 0).toFixed(digits)} ${unit}`;
    });
  }
}
