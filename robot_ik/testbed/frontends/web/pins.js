// Pins: frames that stay at a place, with weight and priority.

import { button, heading, make, menu, refill, show } from "./dom.js";
import { frameMenu, pickButton } from "./part_choice.js";

export const PRIORITIES = [...Array(10).keys()].map((value) => [value, String(value)]);
const LARGEST_WEIGHT = 1000;

/** A field for a weight. `set` shows a value unless it is being typed. */
export function weightField(label, act) {
  const element = make("input", {
    class: "rk-num num rk-weight",
    inputmode: "decimal",
    "aria-label": label,
    onchange: () => {
      const value = Number(element.value);
      element.blur();
      if (Number.isFinite(value)) act(Math.max(0, Math.min(LARGEST_WEIGHT, value)));
    },
  });
  const set = (value) => {
    if (document.activeElement !== element) element.value = String(+value.toPrecision(4));
  };
  return { element, set };
}

export class Pins {
  constructor(channel) {
    this.channel = channel;
    this.rows = [];
    this.table = make("table", { class: "rk-table num rk-goals" });
    this.pick = pickButton(channel, "pin", "Pin a part by a click on it");
    this.frames = frameMenu("frame to pin", (frame) => {
      if (frame) channel.action("pin_frame", { frame });
      this.frames.element.value = "";
    });
    const adding = make("span", { class: "rk-adding" }, this.frames.element, this.pick.element);
    this.element = make("div", {}, heading("Pins", adding), this.table);
  }

  showRobot({ frames }) {
    this.frames.fill([{ name: "", text: "pin …", about: "" }, ...frames]);
  }

  showPick(pick) {
    this.pick.show(pick);
  }

  show({ pins, instances }) {
    show(this.table, pins.length > 0);
    refill(this.table, pins.map(({ frame }) => frame), () => this.build(pins));
    const errors = new Map(instances[0].goals.map(([name, mm]) => [name, mm]));
    pins.forEach((pin, k) => this.rows[k].show(pin, errors.get(`pin ${pin.frame}`)));
  }

  build(pins) {
    const titles = [
      ["frame", ""],
      ["turns", "Whether the frame may turn about its place"],
      ["priority", "0 is served first"],
      ["weight", "against goals of the same priority; 0 ignores the pin"],
      ["mm", "distance by which robot 1 misses it"],
      ["", ""],
    ];
    const head = make("tr", {}, titles.map(([text, title]) => make("th", { title }, text)));
    this.rows = pins.map(({ frame }) => this.row(frame));
    return [head, ...this.rows.map(({ element }) => element)];
  }

  row(frame) {
    let current = null;
    const send = (changes) => {
      const { position, wxyz, weight, priority } = { ...current, ...changes };
      this.channel.command("set_pin", { frame, position, wxyz, weight, priority });
    };
    const turns = make("input", {
      type: "checkbox",
      "aria-label": `${frame} may turn`,
      onchange: () => this.channel.action("pin_frame", { frame, turns: turns.checked }),
    });
    const rank = menu(PRIORITIES, (value) => send({ priority: +value }), {
      label: `priority of pin ${frame}`,
      width: "42px",
    });
    const weight = weightField(`weight of pin ${frame}`, (value) => send({ weight: value }));
    const error = make("td");
    const remove = button("trash", "", () => this.channel.command("remove_pin", { frame }), {
      kind: "plain",
      title: `remove the pin of ${frame}`,
    });
    const element = make(
      "tr",
      {},
      make("td", { title: frame }, frame.replaceAll("_", " ")),
      make("td", {}, turns),
      make("td", {}, rank.element),
      make("td", {}, weight.element),
      error,
      make("td", { class: "rk-narrow" }, remove),
    );
    const showPin = (pin, mm) => {
      current = pin;
      turns.checked = pin.wxyz === null;
      rank.set(pin.priority);
      weight.set(pin.weight);
      error.textContent = mm === undefined ? "–" : mm.toFixed(1);
    };
    return { element, show: showPin };
  }
}
