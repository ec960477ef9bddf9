// Base and effector: from a menu of frames, or by a click on a part in the 3D view.

import { button, make, refill } from "./dom.js";

/** A button that waits for a click on a part in the 3D view; a second press ends that. */
export function pickButton(channel, role, title) {
  const element = button("pick", "", () => act(), { kind: "plain", title });
  const isOn = () => element.getAttribute("aria-pressed") === "true";
  const act = () => channel.action("pick_part", { role: isOn() ? "off" : role });
  const show = (picked) => element.setAttribute("aria-pressed", String(picked === role));
  return { element, show };
}

/** A menu of frames that is filled when the robot is known. */
export function frameMenu(label, act) {
  const element = make("select", {
    class: "rk-num rk-frames",
    "aria-label": label,
    onchange: () => {
      act(element.value);
      element.blur();
    },
  });
  const fill = (rows) =>
    refill(element, rows, () =>
      rows.map(({ name, text, about }) => make("option", { value: name, title: about }, text ?? name)),
    );
  const set = (value) => {
    if (document.activeElement !== element && element.value !== value) element.value = value;
  };
  return { element, fill, set };
}

export class PartChoice {
  constructor(channel) {
    this.tool = frameMenu("effector", (frame) => channel.command("set_tool", { frame }));
    this.base = frameMenu("base", (frame) => channel.command("set_base", { frame }));
    this.picks = [
      pickButton(channel, "tool", "Choose the effector by a click on a part"),
      pickButton(channel, "base", "Choose the base by a click on a part"),
    ];
    this.note = make("p", { class: "rk-note" });
    const row = (text, title, menu, pick) =>
      make(
        "div",
        { class: "rk-row", title },
        make("label", {}, text),
        menu.element,
        pick.element,
      );
    this.element = make(
      "div",
      {},
      row("Effector", "The frame that follows the ball", this.tool, this.picks[0]),
      row("Base", "Only joints between base and effector move", this.base, this.picks[1]),
      this.note,
    );
  }

  showRobot({ frames, chain }) {
    this.frames = frames;
    this.chain = chain.length;
    this.tool.fill(frames);
    this.fillBases("");
  }

  /** Offer the frames that carry the effector, and the base that is chosen. */
  fillBases(chosen) {
    const carriers = this.frames.filter(({ name, base }) => base || name === chosen);
    this.base.fill([{ name: "", text: "all joints move", about: "" }, ...carriers]);
  }

  showPick(pick) {
    for (const one of this.picks) one.show(pick);
  }

  show({ tool, base }) {
    this.fillBases(base);
    this.tool.set(tool);
    this.base.set(base);
    const count = this.chain === 1 ? "1 joint moves" : `${this.chain} joints move`;
    this.note.textContent = base ? `${count}: those from ${base} to ${tool}.` : `${count}.`;
  }
}
