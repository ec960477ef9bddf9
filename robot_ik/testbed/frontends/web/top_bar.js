// The bar at the top: robot, figure, state, start, reset, STOP. Its parts keep their places.

import { showRobotButton } from "./dialogs.js";
import { button, icon, make, segmented, show } from "./dom.js";

const MOTIONS = {
  curve: "following the curve",
  random: "ball at random places",
  hand: "following the ball",
  joints: "joints set by hand",
  timeline: "on the timeline",
  plan: "on the planned motion",
  course: "following a course of thesis A00",
};

export class TopBar {
  /**
   * @param acts Functions: stop, start, reset, robots, help, theme, camera.
   */
  constructor(channel, acts) {
    this.runIcon = "";
    this.robotPlace = make("span", { class: "rk-robot-name" }, make("span", {}, "…"));
    this.robot = make(
      "button",
      {
        type: "button",
        class: "rk-btn rk-robot",
        title: "Choose a robot (G)",
        "aria-label": "robot",
        onclick: acts.robots,
      },
      this.robotPlace,
      icon("down"),
    );
    this.figure = segmented(
      [
        ["off", "Methods", "A method solves"],
        ["active", "Active", "The figure acts whenever the ball moves"],
        ["passive", "Passive", "The figure acts on demand"],
      ],
      (mode) => channel.command("set_figure", { mode }),
      { label: "what moves the figure" },
    );
    this.act = button("", "Act", () => channel.command("act"), {
      kind: "primary",
      title: "The figure acts on the ball where it is (Space)",
    });
    this.cameraButton = button("camera", "Camera", acts.camera, {
      kind: "opt",
      title: "Picture of the camera (V)",
    });
    this.dot = make("i", { class: "rk-dot" });
    this.text = make("span", {}, "getting ready");
    this.run = button("pause", "Pause", acts.start, {
      kind: "rk-run",
      title: "Start or pause (Space)",
    });
    this.stop = make(
      "button",
      { type: "button", class: "rk-stop", title: "Everything holds still (Esc)", onclick: acts.stop },
      icon("hand"),
      "STOP",
    );
    this.element = make(
      "header",
      { class: "rk-top" },
      make("div", { class: "rk-brand opt" }, icon("arm")),
      this.robot,
      this.cameraButton,
      this.figure.element,
      this.act,
      make("div", { class: "rk-space" }),
      make("div", { class: "rk-state", role: "status" }, this.dot, this.text),
      this.run,
      button("reset", "", acts.reset, { kind: "plain", title: "Reset robot and ball (R)" }),
      button("moon", "", acts.theme, { kind: "plain opt", title: "Light or dark" }),
      button("help", "", acts.help, { kind: "plain opt", title: "Keys (?)" }),
      this.stop,
    );
    this.showProgram({ camera: false });
    show(this.figure.element, false);
    show(this.act, false);
  }

  showProgram({ camera }) {
    show(this.cameraButton, camera);
  }

  showSettings({ camera }) {
    this.cameraButton.setAttribute("aria-pressed", String(camera));
  }

  showRobot(robot) {
    showRobotButton(this.robotPlace, robot);
  }

  state(view) {
    if (view.busy) return view.busy;
    if (!view.ready) return view.state;
    if (!view.running) return view.arm ? "stopped: press Start, then Follow" : "stopped: press Start";
    if (view.figure) return view.figure.action;
    if (view.state !== "running") return view.state;
    return view.timeline.playing ? "playing the timeline" : MOTIONS[view.motion];
  }

  show(view) {
    const text = this.state(view);
    this.dot.className = "rk-dot";
    if (view.busy || !view.ready) this.dot.classList.add("busy");
    else if (!view.running) this.dot.classList.add("held");
    if (this.text.textContent !== text) {
      this.text.textContent = text;
      this.text.title = text;
    }
    const name = view.running ? "pause" : "play";
    if (name !== this.runIcon) {
      this.run.replaceChildren(icon(name), view.running ? "Pause" : "Start");
      this.run.classList.toggle("primary", !view.running);
      this.runIcon = name;
    }
    show(this.figure.element, view.can_act);
    this.figure.set(view.figure?.mode ?? "off");
    show(this.act, view.figure?.mode === "passive");
  }
}
