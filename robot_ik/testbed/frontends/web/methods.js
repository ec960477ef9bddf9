// One card an instance: its method, how it does, its parameters. Below them the ball and the plot.

import { heading, icon, make, menu, refill, segmented, show, toggle } from "./dom.js";
import { Plot, QUANTITIES } from "./plot.js";

const HAND_MS = 1200; // a control that was just moved does not follow the session
const SLIDER_STEPS = 1000;
const DECADES = 100; // a range whose ends differ by this factor is logarithmic

const LIMITS = [
  {
    name: "max_iterations",
    help: "Most iterations of one solve (thesis S12: max attempts)",
    lower: 1,
    upper: 10000,
    usual: [1, 1000],
    whole: true,
  },
  {
    name: "success_distance",
    help: "Distance to the ball at which a solve counts as solved (thesis S12)",
    unit: "mm",
    lower: 0.001,
    upper: 1000,
    usual: [0.01, 100],
  },
];

/** Figures of a card: label, help, text. */
const FIGURES = [
  ["steps", "Mean iterations of a solve", (one) => one.mean_iterations.toFixed(1)],
  [
    "time",
    "Mean processor time of a solve in this page. Comparable times: robot-ik bench",
    (one) => `${one.mean_us.toFixed(0)} µs`,
  ],
  ["p99", "99 of 100 solves take at most this time", (one) => `${one.p99_us.toFixed(0)} µs`],
  [
    "solved",
    "Share of solves that met the ball, of at most the last 1000",
    (one) => `${(100 * one.solved).toFixed(0)} %`,
  ],
];

const PACES = [
  [0, "in every frame"],
  [0.5, "every 0.5 s"],
  [1, "every second"],
  [2, "every 2 s"],
  [5, "every 5 s"],
];

/** A widget for an option: a switch, a menu, or a slider with a number beside it. */
function parameter(option, act) {
  const { name, help, unit, choices } = option;
  const text = name.replaceAll("_", " ");
  const range = option.lower == null ? "" : `; ${option.lower} to ${option.upper}`;
  const title = `${help}${unit ? ` (${unit})` : ""}${range}`;
  let touched = 0;
  const changed = (value) => {
    touched = Date.now();
    act(value);
  };
  const follow = (set) => (value) => {
    if (Date.now() - touched > HAND_MS) set(value);
  };
  if (option.switch) {
    const box = toggle(text, false, changed, title);
    return { element: box.element, show: follow(box.set) };
  }
  const label = make("label", { title }, text);
  if (choices?.length) {
    const list = menu(choices.map((choice) => [choice, choice]), changed, { label: text });
    const element = make("div", { class: "rk-param" }, label, make("span"), list.element);
    return { element, show: follow(list.set) };
  }
  return numberParameter(option, label, text, changed, follow);
}

function numberParameter({ lower, upper, usual, whole }, label, text, changed, follow) {
  const first = usual.length ? usual[0] : (lower ?? 0);
  const last = usual.length ? usual[1] : (upper ?? 1);
  const isLog = first > 0 && last / first >= DECADES;
  const allowed = (value) => {
    const inside = Math.min(upper ?? Infinity, Math.max(lower ?? -Infinity, value));
    return whole ? Math.round(inside) : inside;
  };
  const shareOf = (value) =>
    isLog ? Math.log(value / first) / Math.log(last / first) : (value - first) / (last - first);
  const valueOf = (share) =>
    isLog ? first * (last / first) ** share : first + share * (last - first);
  const textOf = (value) => (whole ? String(Math.round(value)) : String(+(+value).toPrecision(4)));

  const number = make("input", {
    class: "rk-num num",
    inputmode: "decimal",
    "aria-label": `${text} as a number`,
    onchange: () => {
      const value = Number(number.value);
      if (Number.isFinite(value)) changed(allowed(value));
      number.blur();
    },
  });
  const slider = make("input", {
    type: "range",
    class: "rk-range",
    min: 0,
    max: SLIDER_STEPS,
    "aria-label": text,
  });
  const fill = () => slider.style.setProperty("--p", `${(100 * slider.value) / SLIDER_STEPS}%`);
  slider.addEventListener("input", () => {
    const value = allowed(+valueOf(slider.value / SLIDER_STEPS).toPrecision(3));
    number.value = textOf(value);
    fill();
    changed(value);
  });
  const set = (value) => {
    if (document.activeElement !== number) number.value = textOf(value);
    const share = shareOf(Math.max(value, isLog ? first : -Infinity));
    slider.value = SLIDER_STEPS * Math.max(0, Math.min(1, share));
    fill();
  };
  const element = make("div", { class: "rk-param" }, label, slider, number);
  return { element, show: follow(set) };
}

class MethodCard {
  constructor(k, program, channel) {
    this.k = k;
    this.methods = program.methods;
    this.channel = channel;
    this.one = null;
    const names = Object.keys(program.methods);
    this.menu = make(
      "select",
      {
        class: "rk-select",
        "aria-label": `method of robot ${k + 1}`,
        onchange: () => {
          channel.command("set_method", { instance: k, method: this.menu.value });
          this.menu.blur();
        },
      },
      names.map((name) => make("option", {}, name)),
    );
    this.words = make("div", { class: "rk-word" });
    this.off = make("div", { class: "rk-off num", title: "Error of the tool, by MuJoCo" });
    this.figures = FIGURES.map(() => make("b", {}, "–"));
    const stats = make(
      "div",
      { class: "rk-stats num" },
      FIGURES.map(([label, help], i) =>
        make("div", { title: help }, make("small", {}, label), this.figures[i]),
      ),
    );
    this.params = make("div", { class: "rk-params" });
    const more = make(
      "button",
      {
        type: "button",
        class: "rk-more",
        title: "Parameters",
        "aria-label": `parameters of robot ${k + 1}`,
        onclick: () => this.element.classList.toggle("open"),
      },
      icon("down"),
    );
    this.element = make(
      "div",
      { class: "rk-method", style: `--c:${program.colours[k]}` },
      make(
        "div",
        { class: "rk-method-head" },
        make("i"),
        make("div", {}, this.menu, this.words),
        this.off,
        more,
      ),
      stats,
      this.params,
    );
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
    const children = usual.map(widget);
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
    FIGURES.forEach(([, , text], i) => {
      this.figures[i].textContent = one.count ? text(one) : "–";
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
    this.pace = menu(PACES, (value) => channel.command("set_pace", { seconds: +value }), {
      label: "pace of the random ball",
      width: "124px",
    });
    this.paceRow = make("div", { class: "rk-row" }, make("label", {}, "A new place"), this.pace.element);
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
    this.element = make(
      "div",
      {},
      heading("Methods side by side", this.count.element),
      this.cards.map((card) => card.element),
      this.note,
      heading("Ball", this.motion.element),
      this.speed.element,
      this.paceRow,
      this.restarts.element,
      heading("Last 8 seconds", this.quantity.element),
      this.plot.element,
    );
  }

  show(view, isVisible) {
    this.plot.add(view);
    if (!isVisible) return;
    const count = view.instances.length;
    this.count.set(count);
    this.element.classList.toggle("rk-compact", count > 1);
    this.motion.set(view.motion);
    show(this.paceRow, view.motion === "random");
    show(this.restarts.element, view.motion === "random");
    show(this.speed.element, ["curve", "random"].includes(view.motion));
    this.pace.set(view.pace);
    this.restarts.set(view.restarts);
    this.speed.show(view.speed);
    this.cards.forEach((card, k) => {
      show(card.element, k < count);
      const acting = k === 0 && view.figure !== null;
      if (k < count) card.show(view.instances[k], acting, view.busy);
    });
    const most = Math.max(...view.instances.map((one) => one.count));
    this.note.textContent = most ? `Of the last ${most} solves in this page.` : "";
    this.plot.draw();
  }
}
