// Obstacles, and what the 3D view shows.

import { button, heading, make, show, toggle } from "./dom.js";
import { ObstacleList } from "./obstacle_list.js";
import { PlanBox } from "./plan_box.js";
import { ReachBox } from "./reach_box.js";

export class SceneTab {
  constructor(channel, notice) {
    this.obstacles = new ObstacleList(channel, notice);
    this.plan = new PlanBox(channel);
    this.reach = new ReachBox(channel);
    const switched = (name) => (on) => channel.action(name, { on });
    this.switches = {
      overlay: toggle("Trails and labels", true, switched("show_overlay"), "Over the scene (L)"),
      handles: toggle("Ball handles", true, switched("show_handles"), "Move it along one axis"),
      turn_handles: toggle("Turn handles", false, switched("show_turn_handles"), "Turn the ball"),
      tool_frames: toggle("Tool frames", false, switched("show_tool_frames"), "x red, y green, z blue"),
      wire: toggle("Wire", false, switched("show_wire"), "Robots as lines from joint to joint"),
      regions: toggle(
        "Regions of the figure",
        false,
        switched("show_regions"),
        "Where the figure reaches (green), bends (amber), jumps (violet)",
      ),
      cube: toggle("Test cube", false, switched("show_cube"), "Ball and tool on edges (thesis A00)"),
      dark: toggle("Dark", false, (dark) => channel.action("set_theme", { dark }), "On all pages"),
    };
    this.driving = make("p", { class: "rk-note" });
    this.handOver = button("hand", "Hand over", () => channel.action("hand_over"), {
      title: "The next page that acts drives",
    });
    this.element = make(
      "div",
      {},
      this.obstacles.element,
      this.plan.element,
      this.reach.element,
      heading("Show"),
      Object.values(this.switches).map(({ element }) => element),
      button("fit", "Fit the camera", () => channel.action("fit_camera"), {
        title: "Back to the first view",
      }),
      heading("Who drives"),
      this.driving,
      this.handOver,
    );
  }

  showSettings(settings) {
    for (const [name, one] of Object.entries(this.switches)) one.set(settings[name]);
    this.reach.set(settings.reach);
  }

  showRole(role) {
    show(this.handOver, role.drives);
    const others = role.pages - 1;
    const more = others === 1 ? "1 other page looks." : `${others} other pages look.`;
    if (role.drives) this.driving.textContent = `This page drives. ${more}`;
    else if (role.driven) this.driving.textContent = "Another page drives. This page watches.";
    else this.driving.textContent = "No page drives: the next page that acts does.";
  }

  show(view) {
    show(this.switches.regions.element, view.can_act);
    this.obstacles.show(view);
    this.plan.show(view);
  }
}
