// Dialogs over the page: the gallery of robots, the first steps, the list of keys.

import { button, make, refill } from "./dom.js";

const INTRO_SEEN = "robot_ik.intro.seen";

const STEPS = [
  [
    "Drag the orange ball",
    "The robot follows it. Arrow keys, W and S move it, too.",
    `<circle cx="118" cy="42" r="13" fill="#f58220"/>
     <path d="M24 70 52 34l34 10 20-2" stroke="#64748b" stroke-width="8" fill="none"
       stroke-linecap="round" stroke-linejoin="round"/>
     <path d="M122 42h26m-8-7 8 7-8 7" stroke="currentColor" stroke-width="2.5" fill="none"/>`,
  ],
  [
    "Drag a link or a joint bar",
    "Take any part of the robot, or turn one joint: the ball comes along.",
    `<path d="M20 72 56 30l44 24 34-18" stroke="#64748b" stroke-width="8" fill="none"
       stroke-linecap="round" stroke-linejoin="round"/>
     <circle cx="56" cy="30" r="9" fill="#2563eb"/>
     <path d="M56 14V4m-5 5 5-5 5 5" stroke="currentColor" stroke-width="2.5" fill="none"/>`,
  ],
  [
    "Press 4 to compare",
    "Four methods follow the same ball; the cards show which is better.",
    `<g stroke-width="6" fill="none" stroke-linecap="round" stroke-linejoin="round">
     <path d="M22 72V46l18-14" stroke="#2563eb"/><path d="M62 72V50l14-22" stroke="#0d9488"/>
     <path d="M102 72V44l20-8" stroke="#9333ea"/><path d="M142 72V52l10-26" stroke="#db2777"/></g>`,
  ],
];

/** A dialog with a shade. A click on the shade closes it. */
export class Dialog {
  constructor(label) {
    this.box = make("div", { class: "rk-dialog", role: "dialog", "aria-label": label });
    this.element = make("div", { class: "rk-shade" }, this.box);
    this.element.addEventListener("click", (event) => {
      if (event.target === this.element) this.close();
    });
  }

  get isOpen() {
    return this.element.classList.contains("shown");
  }

  open() {
    this.element.classList.add("shown");
  }

  close() {
    this.element.classList.remove("shown");
  }
}

export class Gallery extends Dialog {
  constructor(program, channel) {
    super("robots");
    this.channel = channel;
    this.cards = program.robots.map((robot) => this.card(robot));
    this.path = make("input", {
      class: "rk-num",
      placeholder: "folder/my_arm.urdf",
      "aria-label": "path of a model",
      style: "text-align:left;height:34px",
    });
    const form = make(
      "form",
      {
        class: "rk-own",
        onsubmit: (event) => {
          event.preventDefault();
          this.choose(this.path.value.trim());
        },
      },
      make("label", {}, "Your own model, an MJCF or URDF file on the program's machine"),
      this.path,
      make("button", { class: "rk-btn", type: "submit" }, "Load"),
    );
    const links = make("input", {
      class: "rk-num num",
      type: "number",
      min: 1,
      max: 500,
      value: 5,
      "aria-label": "links of a chain",
      style: "width:72px;height:34px",
    });
    const chain = make(
      "form",
      {
        class: "rk-own",
        onsubmit: (event) => {
          event.preventDefault();
          this.choose(`chain:${links.value}`);
        },
      },
      make("label", {}, "A chain of ball joints, links of 1 m (thesis A00)"),
      links,
      make("button", { class: "rk-btn", type: "submit" }, "Show the chain"),
    );
    this.box.append(
      make("h2", {}, "Choose a robot"),
      make("div", { class: "rk-gallery" }, this.cards),
      chain,
      form,
    );
  }

  card({ name, about, picture }) {
    const image = picture
      ? make("img", { src: `/testbed/thumbnails/${name}.png`, alt: "", loading: "lazy" })
      : make("div", { class: "rk-no-picture" });
    return make(
      "button",
      { type: "button", "data-robot": name, title: about, onclick: () => this.choose(name) },
      image,
      make("b", {}, name.replaceAll("_", " ")),
      make("small", {}, about),
    );
  }

  choose(name) {
    if (name) this.channel.command("set_robot", { name });
    this.close();
  }

  showRobot(robot) {
    for (const card of this.cards) {
      card.setAttribute("aria-current", String(card.dataset.robot === robot.name));
    }
  }
}

export class Intro extends Dialog {
  /** @param onrobots Called when the reader wants the gallery. */
  constructor(onrobots) {
    super("first steps");
    const steps = STEPS.map(([title, text, picture]) => {
      const step = make("div");
      step.innerHTML = `<svg viewBox="0 0 172 84" aria-hidden="true">${picture}</svg>`;
      step.append(make("b", {}, title), make("p", {}, text));
      return step;
    });
    const another = () => {
      this.close();
      onrobots();
    };
    this.box.append(
      make("h2", {}, "Inverse kinematics you can touch"),
      make("p", {}, "Three things to try:"),
      make("div", { class: "rk-steps" }, steps),
      make(
        "div",
        { class: "rk-actions" },
        button("", "Choose another robot", another),
        button("", "Start", () => this.close(), { kind: "primary" }),
      ),
    );
  }

  /** Open it on the first visit of this browser. */
  openOnce() {
    if (!localStorage.getItem(INTRO_SEEN)) this.open();
  }

  close() {
    super.close();
    localStorage.setItem(INTRO_SEEN, "1");
  }
}

export class KeyList extends Dialog {
  constructor(keys) {
    super("keys");
    const groups = [...new Set(keys.map(({ group }) => group))];
    const row = ({ label, about }) => make("div", {}, about, make("kbd", {}, label));
    const rows = groups.map((group) => [
      make("h3", {}, group),
      ...keys.filter((key) => key.group === group).map(row),
    ]);
    this.box.append(make("h2", {}, "Keys"), make("div", { class: "rk-keys" }, rows.flat()));
  }
}

/** The robot's picture and name in the top bar. */
export function showRobotButton(element, robot) {
  refill(element, [robot.name, robot.picture], () => [
    robot.picture
      ? make("img", { src: `/testbed/thumbnails/${robot.name}.png`, alt: "" })
      : make("div", { class: "rk-no-picture" }),
    make("span", {}, robot.name.replaceAll("_", " ")),
  ]);
}
