// The servo arm that robot 1 drives: state, torque, currents, temperatures.

import { button, heading, make, refill, show } from "./dom.js";

const MODES = [
  ["follow", "Follow", "The arm follows robot 1"],
  ["hold", "Hold", "The arm holds its present pose"],
  ["release", "Torque off", "An arm that is not supported falls"],
  ["teach", "Teach", "Torque off; a hand guides the arm and is recorded"],
  ["replay", "Replay", "Repeats the recorded motion"],
];
const COLUMNS = [
  ["joint", ""],
  ["at", "measured"],
  ["torque", ""],
  ["mA", "motor current"],
  ["°C", "temperature"],
];

export class ArmTab {
  constructor(channel) {
    this.state = make("div", { class: "rk-arm-state" });
    this.limp = make("div", { class: "rk-warning" });
    this.message = make("div", { class: "rk-warning" });
    this.place = make("p", { class: "rk-note" });
    this.buttons = new Map(
      MODES.map(([state, label, title]) => [
        state,
        button("", label, () => channel.command("set_arm", { state }), { title }),
      ]),
    );
    const [follow, hold, release, teach, replay] = this.buttons.values();
    this.save = button("save", "Save the recording", () => channel.action("save_recording"), {
      title: "As CSV: robot-ik servo replay repeats it, too",
    });
    this.recorded = make("small", { class: "num" });
    this.table = make("table", { class: "rk-table num" });
    this.controls = make(
      "div",
      {},
      heading("Servo arm"),
      this.state,
      this.limp,
      make("div", { class: "rk-buttons" }, follow, hold, release),
      this.message,
      this.place,
      heading("By hand", this.recorded),
      make("div", { class: "rk-buttons" }, teach, replay, this.save),
      heading("Servos"),
      this.table,
    );
    this.none = make(
      "p",
      { class: "rk-note" },
      "No arm. Start with ",
      make("code", {}, "robot-ik view --bus sim"),
      " for simulated servos.",
    );
    this.element = make("div", {}, this.controls, this.none);
  }

  show(view) {
    const { arm } = view;
    show(this.controls, arm !== null);
    show(this.none, arm === null);
    if (arm === null) return;
    const asked = arm.mode ? ` · asked: ${arm.mode}` : "";
    this.state.textContent = `${arm.state} on ${arm.port}${asked}`;
    this.limp.textContent = arm.limp;
    show(this.limp, Boolean(arm.limp));
    this.message.textContent = arm.message;
    show(this.message, Boolean(arm.message));
    this.place.textContent = arm.is_shown
      ? `Yellow ghost: the real pose, if it differs by 1° or more. Now ${arm.apart_deg.toFixed(1)}° behind.`
      : `The arm is a ${arm.robot}, another robot than the one on the page.`;
    for (const [state, one] of this.buttons) {
      one.setAttribute("aria-pressed", String(arm.mode === state));
    }
    this.recorded.textContent = `recorded: ${arm.recorded.toFixed(1)} s`;
    refill(this.table, arm.servos, () => [
      make("tr", {}, COLUMNS.map(([text, title]) => make("th", { title }, text))),
      ...arm.servos.map((servo) => this.row(servo)),
    ]);
  }

  row({ joint, position, torque, current, temperature, errors }) {
    const cells = [joint, position, torque ? "on" : "off", current, temperature];
    const row = make("tr", { title: errors }, cells.map((text) => make("td", {}, text)));
    row.classList.toggle("rk-bad", Boolean(errors));
    if (errors) row.lastChild.textContent = `${temperature} · ${errors}`;
    return row;
  }
}
