// Live augmented reality: the camera's picture with robot 1 and the ball in it, and its settings.

import { button, heading, make, menu, segmented, show, toggle } from "./dom.js";

const GRAB = 40; // pixels of the picture around the ball, which moves with a moving board
const RATE_MS = 2000; // over which the pictures of this page are counted

/** The picture, over the whole 3D view or in its corner. The mouse drags the ball in it. */
export class ArPane {
  constructor(channel) {
    this.channel = channel;
    this.ball = null;
    this.isHeld = false;
    this.shown = [];
    this.image = make("img", { alt: "augmented reality", draggable: "false" });
    this.image.onload = () => this.loaded();
    this.image.onerror = () => channel.send({ shown: this.next?.number ?? 0 });
    this.text = make("span", { class: "num" });
    this.element = make(
      "div",
      { class: "rk-ar rk-hidden" },
      this.image,
      make(
        "div",
        { class: "rk-ar-bar" },
        this.text,
        button("fit", "", () => channel.action("place_ar", { place: this.otherPlace }), {
          kind: "plain",
          title: "Over the whole view, or in its corner",
        }),
      ),
    );
    this.image.addEventListener("pointerdown", (event) => this.pressed(event));
    this.image.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) {
      this.image.addEventListener(name, () => {
        this.isHeld = false;
      });
    }
  }

  get otherPlace() {
    return this.place === "whole" ? "corner" : "whole";
  }

  /** Pixel of the picture under the mouse. The picture fits into its box. */
  pixel({ clientX, clientY }) {
    const { naturalWidth: width, naturalHeight: height } = this.image;
    const box = this.image.getBoundingClientRect();
    const scale = Math.min(box.width / width, box.height / height);
    const u = (clientX - box.left - (box.width - scale * width) / 2) / scale;
    const v = (clientY - box.top - (box.height - scale * height) / 2) / scale;
    return [u, v];
  }

  isNearBall(event) {
    if (!this.ball || !Number.isFinite(this.ball[0])) return false;
    const [u, v] = this.pixel(event);
    return Math.hypot(u - this.ball[0], v - this.ball[1]) < this.ball[2] + GRAB;
  }

  pressed(event) {
    event.preventDefault();
    if (!this.isNearBall(event)) return;
    this.image.setPointerCapture(event.pointerId);
    this.isHeld = true;
    this.drag(event, true);
  }

  moved(event) {
    const free = this.isNearBall(event) ? "grab" : "";
    this.image.style.cursor = this.isHeld ? "grabbing" : free;
    if (this.isHeld) this.drag(event, false);
  }

  drag(event, begins) {
    const [u, v] = this.pixel(event);
    this.channel.action("drag_ar_ball", { u, v, begins });
  }

  showSettings({ on, place }) {
    this.place = place;
    show(this.element, on);
    this.element.classList.toggle("corner", place === "corner");
  }

  /** Show a picture. The program sends the next one after that. */
  showPicture(picture) {
    this.next = picture;
    this.image.src = URL.createObjectURL(picture.jpeg);
  }

  loaded() {
    URL.revokeObjectURL(this.image.src);
    const { number, taken, ball } = this.next;
    this.ball = ball;
    this.channel.send({ shown: number });
    const now = Date.now();
    const age = now - 1e3 * taken;
    this.shown = [...this.shown.filter((one) => one.now > now - RATE_MS), { now, age }];
  }

  /** Pictures a second and their mean age in milliseconds, of the last two seconds. */
  get rate() {
    const count = this.shown.length;
    if (count < 2) return [0, 0];
    const seconds = (this.shown[count - 1].now - this.shown[0].now) / 1e3;
    const age = this.shown.reduce((sum, one) => sum + one.age, 0) / count;
    return [seconds > 0 ? (count - 1) / seconds : 0, age];
  }

  showStatus(status) {
    const [rate, age] = this.rate;
    const isLost = !status.problem && !status.board && status.rate_hz > 0;
    let text = status.note;
    if (status.problem) text = `no picture: ${status.problem}`;
    else if (isLost) text = "the board is not in the picture";
    else if (status.rate_hz > 0) text = `${rate.toFixed(0)} pictures/s · ${age.toFixed(0)} ms old`;
    this.text.textContent = text;
    this.text.classList.toggle("rk-bad", Boolean(status.problem) || isLost);
    this.element.dataset.rate = rate.toFixed(2);
    this.element.dataset.age = age.toFixed(1);
  }
}

/** A row with a label and a text field. */
function field(label, title, act, attributes = {}) {
  const input = make("input", {
    class: "rk-num rk-ar-field",
    "aria-label": label,
    title,
    onchange: () => {
      act();
      input.blur();
    },
    ...attributes,
  });
  const element = make("div", { class: "rk-row", title }, make("label", {}, label), input);
  const set = (value) => {
    if (document.activeElement !== input) input.value = value;
  };
  return { element, input, set };
}

const DELAYS = [0, 50, 100, 150, 200, 250, 300, 400, 500];

/** What the tab shows of the status: label, help, text. */
const FIGURES = [
  ["pictures/s", "Pictures that are tracked and drawn", (s) => s.rate_hz.toFixed(0)],
  ["age", "From the camera's picture to the finished one", (s) => `${s.age_ms.toFixed(0)} ms`],
  ["tracking", "To find the board in a picture", (s) => `${s.track_ms.toFixed(1)} ms`],
  ["drawing", "Robot, ball, shadow and text", (s) => `${s.draw_ms.toFixed(1)} ms`],
  [
    "delay",
    "Between the picture that was tracked and the picture that is shown",
    (s) => `${s.delay_ms.toFixed(0)} ms`,
  ],
  [
    "error",
    "RMS distance between the board's points in the drawing and in the picture",
    (s) => (s.error_px === null ? "–" : `${s.error_px.toFixed(2)} px`),
  ],
];

export class ArTab {
  constructor(channel) {
    this.channel = channel;
    this.settings = null;
    this.on = toggle(
      "Robot in the picture",
      false,
      (on) => channel.action("show_ar", { on }),
      "Draw robot 1 into the pictures of a camera (X)",
    );
    this.place = segmented(
      [
        ["whole", "Whole view"],
        ["corner", "Corner"],
      ],
      (place) => channel.action("place_ar", { place }),
      { small: true, label: "where the picture is" },
    );
    const camera = () => this.sendCamera();
    this.camera = field("Camera", "synthetic, 0, a film, a folder or an address", camera);
    this.lens = field("Calibration", "A file of robot-ik camera calibrate", camera, {
      placeholder: "none: 60° assumed",
    });
    this.board = field("Board", "As robot-ik camera print names it: grid:2x2:50:12.5", camera);
    this.ball = segmented(
      [
        ["virtual", "Keys, mouse", "Arrows, W and S, or drag it in the picture"],
        ["marker", "Marker", "A second printed marker is the ball"],
      ],
      (ball) => this.sendBall({ ball }),
      { small: true, label: "what moves the ball" },
    );
    this.marker = field("Marker id", "Not on the board", () =>
      this.sendBall({ marker: Math.round(Number(this.marker.input.value)) }),
    );
    this.side = field("Side, mm", "Of the marker's black square", () =>
      this.sendBall({ marker_size: Number(this.side.input.value) / 1e3 }),
    );
    this.delay = menu(
      DELAYS.map((ms) => [ms, ms ? `${ms} ms` : "none"]),
      (value) => this.sendDelay({ seconds: Number(value) / 1e3 }),
      { label: "delay of the tracker", width: "92px" },
    );
    this.wait = toggle(
      "Delayed video",
      true,
      (on) => this.sendDelay({ sync: on ? "tracked" : "latest" }),
      "The video waits for the tracker. Off: the newest picture is shown",
    );
    this.predict = toggle(
      "Prediction",
      false,
      (predict) => this.sendDelay({ predict }),
      "Draw where the board will be when the picture is shown (Kalman filter)",
    );
    this.shift = toggle(
      "Image shift",
      false,
      (shift) => this.sendDelay({ shift }),
      "Move the finished drawing by the motion of the board's points",
    );
    this.figures = FIGURES.map(() => make("b", {}, "–"));
    this.note = make("p", { class: "rk-note" });
    this.element = make(
      "div",
      { class: "rk-ar-tab" },
      button("film", "ARKineMan", () => channel.action("begin_preset", { name: "arkineman" }), {
        title: "Thesis P11: a figure that decides, a virtual ball, in the picture of a camera",
      }),
      this.on.element,
      make("div", { class: "rk-row" }, make("label", {}, "Picture"), this.place.element),
      this.note,
      heading("Camera"),
      this.camera.element,
      this.lens.element,
      this.board.element,
      heading("Ball", this.ball.element),
      this.marker.element,
      this.side.element,
      heading("Delay", make("small", {}, "four remedies (Azuma 1997)")),
      make("div", { class: "rk-row" }, make("label", {}, "Tracker's delay"), this.delay.element),
      this.wait.element,
      this.predict.element,
      this.shift.element,
      make(
        "div",
        { class: "rk-stats num" },
        FIGURES.map(([label, title], k) =>
          make("div", { title }, make("small", {}, label), this.figures[k]),
        ),
      ),
    );
  }

  sendCamera() {
    this.channel.action("set_ar_camera", {
      camera: this.camera.input.value,
      intrinsics: this.lens.input.value,
      board: this.board.input.value,
      dictionary: this.settings.dictionary,
    });
  }

  sendBall(changes) {
    const { ball, marker, marker_size } = { ...this.settings, ...changes };
    this.channel.action("set_ar_ball", { ball, marker, marker_size });
  }

  sendDelay(changes) {
    const { seconds, sync, predict, shift } = { ...this.settings, ...changes };
    this.channel.action("set_ar_delay", { seconds, sync, predict, shift });
  }

  showSettings(settings) {
    this.settings = settings;
    this.on.set(settings.on);
    this.place.set(settings.place);
    this.camera.set(settings.camera);
    this.lens.set(settings.intrinsics);
    this.board.set(settings.board);
    this.ball.set(settings.ball);
    this.marker.set(settings.marker);
    this.side.set(+(1e3 * settings.marker_size).toFixed(3));
    const isMarker = settings.ball === "marker";
    show(this.marker.element, isMarker);
    show(this.side.element, isMarker);
    this.delay.set(Math.round(1e3 * settings.seconds));
    this.wait.set(settings.sync === "tracked");
    this.predict.set(settings.predict);
    this.shift.set(settings.shift);
  }

  showStatus(status) {
    const isRunning = status.rate_hz > 0;
    FIGURES.forEach(([, , text], k) => {
      this.figures[k].textContent = isRunning ? text(status) : "–";
    });
    this.note.textContent = status.problem || status.note;
    this.note.classList.toggle("rk-bad", Boolean(status.problem));
  }

  show() {}
}
