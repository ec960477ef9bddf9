// The tab Record: key poses as a list, files of the motion, the command log, a film.

import { button, heading, make, refill, show } from "./dom.js";

export class RecordTab {
  constructor(program, channel) {
    this.channel = channel;
    this.list = make("table", { class: "rk-table num" });
    this.empty = make(
      "p",
      { class: "rk-note" },
      "No key pose yet. Pose the robot and press Record pose, below the scene.",
    );
    const file = (text, act, title, name = "save") => button(name, text, act, { title });
    const save = (format) => () => channel.action("save_motion", { format });
    this.film = file(
      "Film this",
      () => channel.action("film_session"),
      "Films the command log as MP4, in another process",
      "film",
    );
    show(this.film, program.film);
    this.element = make(
      "div",
      {},
      heading("Key poses", make("small", {}, "seconds")),
      this.list,
      this.empty,
      heading("The motion as a file"),
      make(
        "div",
        { class: "rk-buttons" },
        file("Poses", () => channel.action("save_poses"), "poses.toml, for robot_ik.motion.KeyPoses"),
        file("CSV", save("csv"), "Joint values, for robot-ik servo replay"),
        file("BVH", save("bvh"), "For Blender and other animation programs"),
        file("HTML", () => channel.action("share_motion"), "Plays in any browser", "share"),
      ),
      heading("The session"),
      make(
        "div",
        { class: "rk-buttons" },
        file("Save the command log", () => channel.action("save_log"), "Contains every command"),
        this.film,
      ),
      make(
        "p",
        { class: "rk-note" },
        "Attach the log to a bug report. ",
        make("code", {}, "robot-ik view --replay FILE"),
        " repeats it to the same bits. ",
        make("code", {}, "robot-ik view --replay FILE --video OUT.mp4"),
        " films it.",
      ),
    );
  }

  show(view) {
    const { times, names } = view.timeline;
    show(this.empty, !times.length);
    refill(this.list, [times, names], () => names.map((name, k) => this.row(name, times[k], k)));
  }

  row(name, time, index) {
    const input = make("input", {
      class: "rk-num num",
      style: "width:74px",
      "aria-label": `time of ${name}`,
      value: time.toFixed(2),
      onchange: () => {
        const seconds = Number(input.value);
        input.blur();
        if (Number.isFinite(seconds) && seconds >= 0) {
          this.channel.command("move_pose", { index, time: seconds });
        }
      },
    });
    const go = button("play", "", () => this.channel.command("scrub", { time }), {
      kind: "plain",
      title: `show ${name}`,
    });
    const remove = button("trash", "", () => this.channel.command("remove_pose", { index }), {
      kind: "plain",
      title: `remove ${name}`,
    });
    return make(
      "tr",
      {},
      make("td", {}, name),
      make("td", {}, input),
      make("td", { class: "rk-narrow" }, go),
      make("td", { class: "rk-narrow" }, remove),
    );
  }
}

