// What lies over the 3D view: the ball's position, the mode, the figure's decision, hints, notices.

import { make, refill, show } from "./dom.js";

const NOTICE_MS = 5000;

/** Where the ball is, by what moves it. */
const BALL_WORDS = {
  curve: "on a curve",
  random: "at random places",
  hand: "by hand",
  joints: "at the tool",
  timeline: "at the tool",
  plan: "at the goal of the plan",
  course: "on a course",
};

const PICK_WORDS = {
  tool: "Click the part that follows the ball.",
  base: "Click the part that stays: joints between it and the effector move.",
  pin: "Click the part to pin at its present place.",
};

/** The keys of the ball: along the world's axes, as in thesis P11, or relative to the view. */
function ballKeys(isAlongAxes) {
  if (!isAlongAxes) return [["↑ ↓ ← → W S", "ball"]];
  return [
    ["← →", "ball x"],
    ["↑ ↓", "y"],
    ["W S", "z"],
  ];
}

export class Overlay {
  constructor() {
    this.isShown = true;
    this.numbers = ["x", "y", "z"].map(() => make("b"));
    const axes = ["x", "y", "z"].map((axis, k) => make("span", {}, axis, this.numbers[k]));
    this.ball = make("div", { class: "rk-card rk-ball num" }, make("i"), axes, make("span", {}, "m"));
    this.mode = make("div", { class: "rk-card rk-mode" });
    this.watching = make(
      "div",
      { class: "rk-card rk-watching", role: "status" },
      make("b", {}, "You watch."),
      " Another browser drives. STOP works here, too.",
    );
    this.picking = make("div", { class: "rk-card rk-picking", role: "status" });
    this.missing = make("details", { class: "rk-card rk-missing" });
    this.hud = make("div", { class: "rk-hud" }, this.watching, this.picking, this.ball, this.mode, this.missing);
    this.title = make("strong");
    this.action = make("span", { class: "rk-tag" });
    this.reason = make("p");
    this.phase = make("i");
    this.decision = make(
      "div",
      { class: "rk-card rk-decision" },
      this.title,
      this.action,
      this.reason,
      make("div", { class: "bar" }, this.phase),
    );
    this.hint = make("div", { class: "rk-hint" });
    this.notices = make("div", { class: "rk-toasts", role: "alert" });
    this.elements = [this.hud, this.hint, this.decision, this.notices];
    this.lastMessage = "";
    show(this.watching, false);
    show(this.picking, false);
    show(this.missing, false);
  }

  /** Show a notice for some seconds. */
  notice(text) {
    if (this.notices.lastChild?.textContent === text) return;
    const one = make("div", { class: "rk-toast" }, text);
    this.notices.append(one);
    setTimeout(() => one.remove(), NOTICE_MS);
  }

  showSettings({ overlay, pick }) {
    this.isShown = overlay;
    show(this.picking, pick !== "off");
    this.picking.textContent = PICK_WORDS[pick] ?? "";
    for (const element of [this.ball, this.mode, this.hint]) show(element, overlay);
  }

  showRole({ drives, driven }) {
    show(this.watching, driven && !drives);
  }

  showRobot({ missing_meshes: names }) {
    show(this.missing, names.length > 0);
    const meshes = names.length === 1 ? "1 mesh is" : `${names.length} meshes are`;
    refill(this.missing, names, () => [
      make("summary", {}, `${meshes} not drawn`),
      make("p", {}, "No such file, or neither STL nor OBJ. The kinematics is complete."),
      make("ul", {}, names.map((name) => make("li", {}, name))),
    ]);
  }

  show(view, keysMoveCamera, isArOn) {
    view.ball.forEach((value, k) => {
      this.numbers[k].textContent = value.toFixed(3);
    });
    this.mode.textContent = this.modeText(view);
    if (view.message && view.message !== this.lastMessage) this.notice(view.message);
    this.lastMessage = view.message;
    this.showDecision(view.figure);
    this.showHint(view, keysMoveCamera, isArOn);
  }

  modeText({ figure, kind, motion }) {
    if (!figure) return `${kind} · ${BALL_WORDS[motion]}`;
    if (figure.locked) return `${figure.mode} · the ball is locked`;
    if (figure.waiting) return `${figure.mode} · place the ball, press Space`;
    return `${figure.mode} · follows the ball`;
  }

  showDecision(figure) {
    const visible = Boolean(figure) && this.isShown;
    this.decision.classList.toggle("shown", visible);
    document.body.toggleAttribute("data-rk-decides", visible);
    if (!figure) return;
    const arm = figure.arm ? ` with the ${figure.arm} hand` : "";
    const then = figure.then ? `, then ${figure.then}` : "";
    const title = figure.waiting ? "waits for you" : `${figure.decision}${then}${arm}`;
    this.title.textContent = title.charAt(0).toUpperCase() + title.slice(1);
    this.action.textContent = `now: ${figure.action}`;
    const waits = "Place the ball, then press Act or Space.";
    this.reason.textContent = figure.waiting ? waits : figure.reason;
    this.phase.style.width = `${100 * figure.phase}%`;
  }

  showHint(view, keysMoveCamera, isArOn) {
    const space = view.figure?.mode === "passive" ? "act" : "pause";
    const pairs = keysMoveCamera
      ? [
          ["W A S D Q E", "camera"],
          ["C", "keys move the ball"],
        ]
      : [
          ...ballKeys(view.figure || isArOn),
          ...(view.figure ? [["I", "active, passive"]] : []),
          ["Space", view.running ? space : "start"],
          ["R", "reset"],
          ["C", "keys move the camera"],
          ["?", "all keys"],
        ];
    refill(this.hint, pairs, () =>
      pairs.map(([keys, text]) => make("span", {}, make("kbd", {}, keys), ` ${text}`)),
    );
  }
}
