// One card for each instance: its method, state and parameters. Below: the ball and the plot.

import { heading, icon, make, menu, refill, segmented, show, toggle } from "./dom.js";
import { parameter } from "./parameter.js";
import { Plot, QUANTITIES } from "./plot.js";
import { Theses } from "./theses.js";

const LIMITS = [
  {
    name: "max_iterations",
    help: "Most iterations of one solve (thesis S12: max attempts)",
    lower: 1,
    upper: 10000,
    whole: true,
  },
  {
    name: "success_distance",
    help: "Distance to the ball at which a solve counts as solved (thesis S12)",
    unit: "mm",
    lower: 0.001,
    upper: 1000,
  },
];

const PACE = {
  name: "pace",
  label: "new place after",
  help: "Time at each random place; 0: a new place in every frame (thesis S12)",
  unit: "s",
  lower: 0,
  upper: 60,
  usual: [0, 2],
};

/** A number with one digit after the point, or none if it is large. */
const figure = (value) => value.toFixed(value < 99.95 ? 1 : 0);

/** Figures of a card: label, help, text. */
const FIGURES = [
  ["steps", "Mean iterations of a solve", (one) => figure(one.mean_iterations)],
  [
    "time",
    (one) =>
      "Mean processor time of a solve in this page. Comparable times: robot-ik bench. " +
      `99 of 100 solves take at most ${one.p99_us.toFixed(0)} µs`,
    (one) => `${one.mean_us.toFixed(0)} µs`,
  ],
  [
    "jump",
    "Largest change of a joint between two frames: a method that jumps has a large one",
    (one) => `${figure(one.jump_deg)}°`,
  ],
  [
    "solved",
    "Share of solves that met the ball, of at most the last 1000",
    (one) => `${(100 * one.solved).toFixed(0)} %`,
  ],
];

class MethodCard {
  constructor(k, program, channel) {
    this.k = k;
    this.methods = program.methods;
    this.channel = channel;
    this.one = null;
    this.name = make(
      "button",
      {
        type: "button",
        class: "rk-name",
        title: "Show or hide the parameters",
        "aria-expanded": "false",
        "aria-label": `parameters of robot ${k + 1}`,
        onclick: () => this.unfold(!this.element.classList.contains("open")),
      },
      make("span", {}, "…"),
      icon("down"),
    );
    const names = Object.keys(program.methods);
    this.menu = make(
      "select",
      {
        class: "rk-num rk-choose",
        title: "Choose another method (M)",
        "aria-label": `method of robot ${k + 1}`,
        onchange: () => {
          channel.command("set_method", { instance: k, method: this.menu.value });
          this.menu.blur();
        },
      },
      names.map((name) => make("option", {}, name)),
    );
    this.limits = toggle(
      "joint limits",
      true,
      (on) => channel.command("set_limits", { on, instance: k }),
      "Whether the joints of this robot keep their limits",
    );
    this.words = make("div", { class: "rk-word" });
    this.off = make("div", { class: "rk-off num", title: "Error of the tool, by MuJoCo" });
    this.figures = FIGURES.map(() => make("b", {}, "–"));
    const stats = make(
      "div",
      { class: "rk-stats num" },
      FIGURES.map(([label, help], i) =>
        make(
          "div",
          { title: typeof help === "string" ? help : "" },
          make("small", {}, label),
          this.figures[i],
        ),
      ),
    );
    this.params = make("div", { class: "rk-params" });
    this.element = make(
      "div",
      { class: "rk-method", style: `--c:${program.colours[k]}` },
      make(
        "div",
        { class: "rk-method-head" },
        make("i"),
        make("div", {}, this.name, this.words),
        this.off,
        make("div", { class: "rk-swap" }, icon("swap"), this.menu),
      ),
      stats,
      this.params,
    );
  }

  unfold(open) {
    this.element.classList.toggle("open", open);
    this.name.setAttribute("aria-expanded", String(open));
  }

  /** Make the parameters of a method; rare options are folded away. */
  rebuild(method) {
    this.shown = method;
    this.widgets = {};
    const options = this.methods[method] ?? [];
    const usual = [...LIMITS, ...options.filter((option) => !option.rare)];
    const rare = options.filter((option) => option.rare);
    const widget = (option) => {
      this.widgets[option.name] = parameter(option, (value) => this.set(option.name, value));
      return this.widgets[option.name].element;
    };
    const children = [this.limits.element, ...usual.map(widget)];
    if (!options.length) {
      children.push(make("p", { class: "rk-note" }, "A closed form has no parameters."));
    }
    if (rare.length) {
      const summary = make("summary", {}, `${rare.length} more`);
      children.push(make("details", { class: "rk-rare" }, summary, rare.map(widget)));
    }
    this.params.replaceChildren(...children);
  }

  set(name, value) {
    const limits = {
      instance: this.k,
      iterations: this.one.iterations_limit,
      distance: this.one.distance_mm / 1e3,
    };
    if (name === "max_iterations") {
      this.channel.command("set_budget", { ...limits, iterations: value });
    } else if (name === "success_distance") {
      this.channel.command("set_budget", { ...limits, distance: value / 1e3 });
    } else {
      this.channel.command("set_option", { instance: this.k, name, value });
    }
  }

  show(one, acting, busy) {
    this.one = one;
    if (!one.method) return;
    if (this.shown !== one.method) this.rebuild(one.method);
    if (document.activeElement !== this.menu && !busy) this.menu.value = one.method;
    const name = this.name.firstChild;
    if (name.textContent !== one.method) name.textContent = one.method;
    this.limits.set(one.limited);
    this.menu.disabled = acting;
    this.element.classList.toggle("acting", acting);
    const words = acting ? "the figure decides by itself" : one.words;
    if (this.words.textContent !== words) this.words.textContent = words;
    this.words.className = "rk-word";
    if (!one.able) this.words.classList.add("no");
    else if (one.met) this.words.classList.add("ok");
    else if (one.stuck) this.words.classList.add("warn");
    this.words.title = [one.status, one.note].filter(Boolean).join("; ");
    const [, number, unit] = one.off.match(/^([\d.]+)\s*(.*)$/) ?? [null, one.off, ""];
    refill(this.off, one.off, () => [number, make("small", {}, unit)]);
    FIGURES.forEach(([, help, text], i) => {
      this.figures[i].textContent = one.count ? text(one) : "–";
      if (typeof help !== "string") this.figures[i].parentElement.title = help(one);
    });
    this.widgets.max_iterations.show(one.iterations_limit);
    this.widgets.success_distance.show(one.distance_mm);
    for (const [name, value] of Object.entries(one.options)) this.widgets[name]?.show(value);
  }
}

export class MethodsTab {
  constructor(program, channel) {
    const small = { small: true };
    this.cards = program.colours.map((_, k) => new MethodCard(k, program, channel));
    this.count = segmented(
      [
        [1, "1", "One robot (key 1)"],
        [2, "2", "Compare two (key 2)"],
        [4, "4", "Compare four (key 4)"],
      ],
      (count) => channel.command("set_count", { count }),
      { ...small, label: "robots side by side" },
    );
    this.motion = segmented(
      [
        ["curve", "On a curve"],
        ["random", "Random"],
        ["hand", "By hand"],
      ],
      (motion) => channel.command("set_motion", { motion }),
      { ...small, label: "how the ball moves" },
    );
    this.pace = parameter(PACE, (seconds) => channel.command("set_pace", { seconds }));
    this.restarts = toggle(
      "Restarts",
      true,
      (on) => channel.command("set_restarts", { on }),
      "A method that does not reach the ball tries again from random joint angles",
    );
    this.speed = parameter(
      { name: "speed", help: "Speed of the ball; 1 is real time", usual: [0, 3], lower: 0, upper: 3 },
      (value) => channel.command("set_speed", { speed: value }),
    );
    this.plot = new Plot(program.colours);
    this.quantity = menu(
      Object.entries(QUANTITIES).map(([name, { label }]) => [name, label]),
      (name) => this.plot.choose(name),
      { label: "what is plotted", width: "180px" },
    );
    this.note = make("p", { class: "rk-note" });
    this.theses = new Theses(program, channel);
    this.element = make(
      "div",
      {},
      heading("Methods side by side", this.count.element),
      this.cards.map((card) => card.element),
      this.note,
      heading("Ball", this.motion.element),
      this.speed.element,
      this.pace.element,
      this.restarts.element,
      heading("Last 8 seconds", this.quantity.element),
      this.plot.element,
      this.theses.element,
    );
  }

  show(view, isVisible) {
    this.plot.add(view);
    if (!isVisible) return;
    const count = view.instances.length;
    this.count.set(count);
    this.element.classList.toggle("rk-compact", count > 1);
    this.motion.set(view.motion);
    show(this.pace.element, view.motion === "random");
    show(this.restarts.element, view.motion === "random");
    show(this.speed.element, ["curve", "random", "course"].includes(view.motion));
    this.pace.show(view.pace);
    this.restarts.set(view.restarts);
    this.speed.show(view.speed);
    this.cards.forEach((card, k) => {
      show(card.element, k < count);
      const acting = k === 0 && view.figure !== null;
      if (k < count) card.show(view.instances[k], acting, view.busy);
    });
    const frames = Math.max(...view.instances.map((one) => one.count));
    this.note.textContent = frames ? `Of the last ${frames} frames with a request.` : "";
    this.theses.show(view);
    this.plot.draw();
  }
}
