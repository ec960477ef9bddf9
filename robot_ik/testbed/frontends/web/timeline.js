// Key poses on a time axis: record, drag, scrub, play, load, save, share.

import { button, icon, make, refill, show } from "./dom.js";

const SHORTEST_SPAN = 4; // seconds that the axis shows at least
const ROOM = 1.15; // of the axis after the last pose
const LABELS = 12; // seconds on the axis at most
const CLICK_PIXELS = 4; // a shorter move of a diamond is a click

export class TimeLine {
  constructor(channel) {
    this.channel = channel;
    this.view = { times: [], names: [], now: 0, playing: false };
    this.playIcon = "";
    this.play = button("play", "", () => this.togglePlay(), {
      kind: "rk-round",
      title: "Play without inverse kinematics (Enter)",
    });
    this.head = make("div", { class: "head" });
    this.marks = make("div");
    this.line = make(
      "div",
      { class: "rk-line", role: "slider", "aria-label": "time", "aria-valuemin": 0 },
      this.marks,
      this.head,
    );
    this.clock = make("div", { class: "rk-clock num" });
    this.file = make("input", {
      type: "file",
      accept: ".toml",
      class: "rk-hidden",
      "aria-label": "file of poses",
      onchange: () => this.load(),
    });
    const record = button("", "Record pose", () => channel.command("record_pose"), {
      kind: "rk-record",
      title: "Keep this pose as a key pose (P)",
    });
    record.prepend(make("span", { class: "rk-reddot" }));
    this.element = make(
      "footer",
      { class: "rk-time" },
      record,
      this.play,
      this.line,
      this.clock,
      button("save", "Save", () => channel.action("save_poses"), {
        kind: "plain",
        title: "Save as poses.toml",
      }),
      button("open", "Load", () => this.file.click(), {
        kind: "plain",
        title: "Load a poses.toml",
      }),
      button("share", "Share", () => channel.action("share_motion"), {
        title: "One HTML file that plays in any browser",
      }),
      this.file,
    );
    this.listen();
  }

  listen() {
    this.line.addEventListener("pointerdown", (event) => {
      if (event.target.classList.contains("key")) return;
      this.line.setPointerCapture(event.pointerId);
      this.isHeld = true;
      this.scrub(event);
    });
    this.line.addEventListener("pointermove", (event) => {
      if (this.isHeld) this.scrub(event);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      this.line.addEventListener(name, () => {
        this.isHeld = false;
      });
    }
  }

  get last() {
    return this.view.times.at(-1) ?? 0;
  }

  get span() {
    return Math.max(SHORTEST_SPAN, ROOM * this.last);
  }

  /** The time under the mouse, seconds. */
  time(event) {
    const box = this.line.getBoundingClientRect();
    return Math.max(0, (this.span * (event.clientX - box.left)) / box.width);
  }

  place(element, time) {
    element.style.left = `${(100 * time) / this.span}%`;
  }

  scrub(event) {
    if (!this.view.times.length) return;
    const time = Math.min(this.last, this.time(event));
    this.channel.command("scrub", { time });
    this.place(this.head, time);
  }

  togglePlay() {
    this.channel.command("play_timeline", { playing: !this.view.playing });
  }

  async load() {
    const file = this.file.files[0];
    if (file) this.channel.command("load_poses", { text: await file.text() });
    this.file.value = "";
  }

  show(timeline) {
    this.view = timeline;
    const { times, names, now, playing } = timeline;
    refill(this.marks, [times, names], () => this.build(times, names));
    show(this.head, times.length > 0);
    if (!this.isHeld) this.place(this.head, Math.min(now, this.span));
    this.line.setAttribute("aria-valuemax", this.last.toFixed(2));
    this.line.setAttribute("aria-valuenow", now.toFixed(2));
    this.clock.textContent = `${now.toFixed(2)} / ${this.last.toFixed(2)} s`;
    const name = playing ? "pause" : "play";
    if (name !== this.playIcon) this.play.replaceChildren(icon(name));
    this.playIcon = name;
    this.play.disabled = times.length < 2;
  }

  build(times, names) {
    if (!times.length) {
      const text = "Pose the robot, press Record pose, and repeat: the motion between the poses is computed";
      return [make("div", { class: "empty" }, text)];
    }
    const bar = make("div", { class: "span", style: `width:${(100 * this.last) / this.span}%` });
    const step = Math.max(1, Math.ceil(this.span / LABELS));
    const count = Math.floor(this.span / step) + 1;
    const ticks = Array.from({ length: count }, (_, k) => {
      const tick = make("div", { class: "tick num" }, `${k * step}s`);
      this.place(tick, k * step);
      return tick;
    });
    return [bar, ...ticks, ...times.map((time, k) => this.key(time, names[k], k))];
  }

  /** A diamond: a click shows its pose, a drag moves it in time, a double click removes it. */
  key(time, name, index) {
    const title = `${name} at ${time.toFixed(2)} s. Drag: other time. Double click: remove.`;
    const key = make("div", { class: "key", title });
    this.place(key, time);
    let start = null;
    key.addEventListener("pointerdown", (event) => {
      key.setPointerCapture(event.pointerId);
      start = event.clientX;
    });
    key.addEventListener("pointermove", (event) => {
      if (start !== null) this.place(key, this.time(event));
    });
    key.addEventListener("pointerup", (event) => {
      const isClick = Math.abs(event.clientX - start) < CLICK_PIXELS;
      start = null;
      if (isClick) this.channel.command("scrub", { time });
      else this.channel.command("move_pose", { index, time: this.time(event) });
    });
    key.addEventListener("dblclick", () => this.channel.command("remove_pose", { index }));
    return key;
  }
}
