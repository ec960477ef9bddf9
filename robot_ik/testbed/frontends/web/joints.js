// Joint bars that can be dragged (forward kinematics). The ball moves with the tool.

import { heading, make, refill, show } from "./dom.js";
import { parameter } from "./parameter.js";

const MANY = 12; // joints from which on there is a filter
const LARGE_STEP = 10; // steps of Page up and Page down
const HINGE_STEP = Math.PI / 180; // rad of an arrow key
const SLIDE_STEP = 1e-3; // m of an arrow key
const LIMIT_SHARE = 1e-4; // of the range: nearer to an end the joint is at its limit

const STEPS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };

class JointRow {
  constructor(joint, colours, channel) {
    this.joint = joint;
    this.channel = channel;
    this.value = 0;
    this.fill = make("u");
    const hasZero = joint.lower < 0 && joint.upper > 0;
    const zero = make("em", { style: `left:${100 * this.share(0)}%` });
    this.marks = colours.map((colour, k) =>
      make("b", { class: k ? "ghost" : "", style: `--c:${colour}` }),
    );
    this.track = make(
      "div",
      {
        class: "rk-track",
        style: `--c:${colours[0]}`,
        tabindex: 0,
        role: "slider",
        "aria-label": joint.name,
        "aria-valuemin": joint.lower,
        "aria-valuemax": joint.upper,
      },
      this.fill,
      hasZero ? zero : null,
      [...this.marks].reverse(),
    );
    this.input = make("input", {
      class: "num",
      "aria-label": `value of ${joint.name}`,
      onchange: () => this.typed(),
    });
    const name = make("span", { title: joint.name }, joint.name.replaceAll("_", " "));
    this.element = make("div", { class: "rk-joint" }, name, this.track, this.input);
    this.listen();
  }

  listen() {
    const { track } = this;
    track.addEventListener("pointerdown", (event) => {
      track.setPointerCapture(event.pointerId);
      track.classList.add("held");
      this.drag(event);
    });
    track.addEventListener("pointermove", (event) => {
      if (this.isHeld) this.drag(event);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      track.addEventListener(name, () => track.classList.remove("held"));
    }
    track.addEventListener("keydown", (event) => {
      let steps = STEPS[event.key] ?? 0;
      if (event.key === "PageUp") steps = LARGE_STEP;
      if (event.key === "PageDown") steps = -LARGE_STEP;
      if (!steps) return;
      event.preventDefault();
      this.send(this.value + steps * (this.joint.hinge ? HINGE_STEP : SLIDE_STEP));
    });
  }

  get isHeld() {
    return this.track.classList.contains("held");
  }

  share(value) {
    const { lower, upper } = this.joint;
    return Math.max(0, Math.min(1, (value - lower) / (upper - lower)));
  }

  drag(event) {
    const box = this.track.getBoundingClientRect();
    const { lower, upper } = this.joint;
    const share = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
    this.send(lower + share * (upper - lower));
  }

  typed() {
    const value = parseFloat(this.input.value) * (this.joint.hinge ? Math.PI / 180 : 1e-3);
    this.input.blur();
    if (Number.isFinite(value)) this.send(value);
  }

  send(value) {
    const { lower, upper, name, limited } = this.joint;
    const allowed = limited ? Math.max(lower, Math.min(upper, value)) : value;
    this.channel.command("set_joint", { joint: name, value: allowed });
    this.show([allowed]);
  }

  /** Show the values of all instances, or of the first alone. */
  show(values) {
    [this.value] = values;
    this.marks.forEach((mark, k) => {
      show(mark, k < values.length);
      if (k >= values.length) return;
      const share = this.share(values[k]);
      const atEnd = share < LIMIT_SHARE || share > 1 - LIMIT_SHARE;
      mark.style.left = `${100 * share}%`;
      mark.classList.toggle("limit", this.joint.limited && atEnd);
    });
    const zero = this.joint.lower < 0 && this.joint.upper > 0 ? this.share(0) : 0;
    const end = this.share(this.value);
    this.fill.style.left = `${100 * Math.min(zero, end)}%`;
    this.fill.style.width = `${100 * Math.abs(end - zero)}%`;
    this.track.setAttribute("aria-valuenow", this.value.toFixed(4));
    const number = this.joint.hinge ? (this.value * 180) / Math.PI : 1e3 * this.value;
    const text = number.toFixed(1).replace("-0.0", "0.0");
    const shown = this.joint.hinge ? `${text}°` : `${text} mm`;
    if (document.activeElement !== this.input) this.input.value = shown;
  }
}

/** Sliders of the joints' stiffness: a stiffer joint moves less. */
class Stiffness {
  constructor(channel) {
    this.channel = channel;
    this.rows = {};
    this.list = make("div");
    const help = "A stiffer joint moves less. A method without stiffness reports that.";
    this.element = make(
      "details",
      { class: "rk-rare rk-stiffness" },
      make("summary", { title: help }, "Stiffness of the joints"),
      this.list,
    );
  }

  showRobot({ chain }) {
    refill(this.list, chain, () => {
      this.rows = Object.fromEntries(chain.map((joint) => [joint, this.row(joint)]));
      return Object.values(this.rows).map(({ element }) => element);
    });
  }

  row(joint) {
    const option = {
      name: `stiffness of ${joint}`,
      label: joint.replaceAll("_", " "),
      help: "Cost of moving this joint; 1 is usual",
      lower: 0.01,
      upper: 100,
    };
    return parameter(option, (value) => this.channel.command("set_stiffness", { joint, value }));
  }

  show({ stiffness }) {
    for (const [joint, row] of Object.entries(this.rows)) row.show(stiffness[joint] ?? 1);
  }
}

export class JointsTab {
  constructor(program, channel) {
    this.colours = program.colours;
    this.channel = channel;
    this.rows = [];
    this.search = make("input", {
      class: "rk-num",
      placeholder: "Filter joints",
      style: "text-align:left;margin-bottom:8px;height:30px",
      oninput: () => this.filter(),
    });
    this.list = make("div", { class: "rk-joint-list" });
    const hint = make("small", {}, "drag a bar: the ball follows");
    this.stiffness = new Stiffness(channel);
    this.element = make(
      "div",
      {},
      heading("Joints of robot 1", hint),
      this.search,
      this.list,
      this.stiffness.element,
    );
  }

  showRobot(robot) {
    this.rows = robot.joints.map((joint) => new JointRow(joint, this.colours, this.channel));
    this.list.replaceChildren(...this.rows.map((row) => row.element));
    show(this.search, robot.joints.length > MANY);
    this.search.value = "";
    this.stiffness.showRobot(robot);
  }

  filter() {
    const text = this.search.value.toLowerCase().replaceAll(" ", "_");
    for (const row of this.rows) show(row.element, row.joint.name.toLowerCase().includes(text));
  }

  show(view) {
    this.stiffness.show(view);
    this.rows.forEach((row, i) => {
      const values = view.instances.map((one) => one.joints[i]);
      const isComplete = values.every((value) => value !== undefined); // another robot is coming
      if (isComplete && !row.isHeld) row.show(values);
    });
  }
}
