// What the ball asks of the tool, the goals beside it, and the branches of a closed form.

import { heading, make, menu, refill, toggle } from "./dom.js";
import { PartChoice } from "./part_choice.js";
import { PRIORITIES, Pins, weightField } from "./pins.js";

const KINDS = [
  ["pose", "pose: there, turned like the ball"],
  ["position", "position: there, turned in any way"],
  ["orientation", "orientation: turned like the ball, anywhere"],
  ["aim", "aim: point at the ball"],
  ["line", "line: on a line through the ball"],
  ["plane", "plane: in a plane through the ball"],
  ["half_space", "half-space: beyond a plane through the ball"],
];

export class GoalsTab {
  constructor(channel) {
    this.channel = channel;
    this.kinds = menu(KINDS, (kind) => channel.command("set_goal_kind", { kind }), {
      label: "what the ball asks",
    });
    this.parts = new PartChoice(channel);
    this.pins = new Pins(channel);
    this.table = make("table", { class: "rk-table num rk-goals" });
    this.rows = new Map();
    this.limits = toggle(
      "Joint limits",
      true,
      (on) => channel.command("set_limits", { on }),
      "Whether joints keep their limits (O)",
    );
    this.branches = toggle(
      "All branches of a closed form",
      false,
      (on) => channel.command("show_branches", { on }),
      "Every solution as a ghost (B)",
    );
    this.branchList = make("div", { class: "rk-branches" });
    this.element = make(
      "div",
      {},
      heading("Base and effector"),
      this.parts.element,
      heading("The ball asks for"),
      this.kinds.element,
      heading("Goals", make("small", {}, "priority 0 is served first")),
      this.table,
      this.pins.element,
      heading("Rules"),
      this.limits.element,
      this.branches.element,
      this.branchList,
    );
  }

  showRobot(robot) {
    this.parts.showRobot(robot);
    this.pins.showRobot(robot);
  }

  showSettings({ pick }) {
    this.parts.showPick(pick);
    this.pins.showPick(pick);
  }

  show(view) {
    this.parts.show(view);
    this.pins.show(view);
    this.kinds.set(view.kind);
    this.limits.set(view.limits);
    this.branches.set(view.branches !== null);
    const names = view.branches ?? [];
    refill(this.branchList, names, () =>
      names.map((name, index) =>
        make(
          "button",
          {
            type: "button",
            class: "rk-btn small",
            title: "Robot 1 goes on from this branch",
            onclick: () => this.channel.command("pick_branch", { index }),
          },
          name,
        ),
      ),
    );
    refill(this.table, view.extras.map(({ name }) => name), () => this.build(view.extras));
    const errors = new Map(view.instances[0].goals.map(([name, mm, deg]) => [name, [mm, deg]]));
    for (const extra of view.extras) this.rows.get(extra.name).show(extra, errors.get(extra.name));
  }

  build(extras) {
    const titles = [
      ["goal", ""],
      ["on", ""],
      ["priority", "0 is served first"],
      ["weight", "against goals of the same priority; 0 ignores the goal"],
      ["mm", "distance by which robot 1 misses it"],
      ["°", "angle by which robot 1 misses it"],
    ];
    const head = make("tr", {}, titles.map(([text, title]) => make("th", { title }, text)));
    this.rows = new Map(extras.map((extra) => [extra.name, this.row(extra)]));
    return [head, ...[...this.rows.values()].map(({ element }) => element)];
  }

  row({ name, about }) {
    const isBall = name === "ball";
    let current = null;
    const send = (changes) => {
      const { on, priority, weight } = { ...current, ...changes };
      this.channel.command("set_extra_goal", { name, on, priority, weight });
    };
    const box = toggle(name, true, (on) => send({ on }));
    const rank = menu(PRIORITIES, (value) => send({ priority: +value }), {
      label: `priority of ${name}`,
      width: "42px",
    });
    const weight = weightField(`weight of ${name}`, (value) => send({ weight: value }));
    const error = [make("td"), make("td")];
    const element = make(
      "tr",
      {},
      make("td", { title: about }, name.replaceAll("_", " ")),
      make("td", {}, isBall ? null : box.element.lastChild),
      make("td", {}, rank.element),
      make("td", {}, weight.element),
      error,
    );
    const show = (extra, found) => {
      current = extra;
      box.set(extra.on);
      rank.set(extra.priority);
      weight.set(extra.weight);
      error.forEach((cell, k) => {
        cell.textContent = found ? found[k].toFixed(2) : "–";
      });
    };
    return { element, show };
  }
}
