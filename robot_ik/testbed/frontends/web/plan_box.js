// A motion around the obstacles: mark its start, plan it, play it.

import { button, heading, icon, make, show } from "./dom.js";

const STEPS = 1000; // of the slider

export class PlanBox {
  constructor(channel) {
    this.duration = 0;
    this.isHeld = false;
    const command = (name) => () => channel.command(name);
    this.plan = button("arm", "Plan to the ball", command("plan_motion"), {
      title: "Plan a motion of robot 1 from the start to the ball, around the obstacles",
    });
    this.slider = make("input", {
      type: "range",
      class: "rk-range",
      min: 0,
      max: STEPS,
      "aria-label": "time of the planned motion",
      onpointerdown: () => {
        this.isHeld = true;
      },
      onpointerup: () => {
        this.isHeld = false;
      },
      oninput: () => {
        const time = (this.duration * Number(this.slider.value)) / STEPS;
        channel.command("scrub_plan", { time });
      },
    });
    this.play = button(
      "play",
      "",
      () => channel.command("play_plan", { playing: !this.playing }),
      { title: "Play the planned motion" },
    );
    this.remove = button("trash", "", command("remove_plan"), {
      kind: "plain",
      title: "remove the planned motion",
    });
    this.player = make("div", { class: "rk-row" }, this.play, this.slider, this.remove);
    this.text = make("p", { class: "rk-note" });
    this.element = make(
      "section",
      {},
      heading("Planned motion", make("small", {}, "around the obstacles")),
      make(
        "div",
        { class: "rk-buttons" },
        button("record", "Start here", command("mark_plan_start"), {
          title: "Let the motion start at the present posture of robot 1; else it starts at home",
        }),
        this.plan,
      ),
      this.player,
      this.text,
    );
  }

  show({ plan }) {
    this.duration = plan.duration;
    this.playing = plan.playing;
    this.plan.disabled = plan.state === "planning";
    show(this.player, plan.state === "found");
    show(this.text, plan.text !== "");
    this.text.textContent = plan.text;
    this.text.classList.toggle("rk-bad", plan.state === "failed");
    const name = plan.playing ? "pause" : "play";
    if (name !== this.icon) this.play.replaceChildren(icon(name));
    this.icon = name;
    if (!this.isHeld && plan.duration > 0) {
      this.slider.value = String((STEPS * plan.now) / plan.duration);
    }
  }
}
