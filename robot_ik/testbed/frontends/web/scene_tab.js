// Obstacles, and what the 3D view shows.

import { button, heading, make, refill, show, toggle } from "./dom.js";

const SHAPES = [
  ["box", "Box"],
  ["sphere", "Sphere"],
  ["cylinder", "Cylinder"],
];

export class SceneTab {
  constructor(channel) {
    this.channel = channel;
    const add = ([shape, label]) =>
      button(shape, label, () => channel.command("add_obstacle", { shape }), {
        title: "Drag it in the 3D view",
      });
    this.obstacles = make("table", { class: "rk-table num" });
    this.contact = make("div", { class: "rk-warning" });
    const switched = (name) => (on) => channel.action(name, { on });
    this.switches = {
      overlay: toggle("Trails and labels", true, switched("show_overlay"), "Over the scene (L)"),
      handles: toggle("Ball handles", true, switched("show_handles"), "Move it along one axis"),
      turn_handles: toggle("Turn handles", false, switched("show_turn_handles"), "Turn the ball"),
      tool_frames: toggle("Tool frames", false, switched("show_tool_frames"), "x red, y green, z blue"),
      wire: toggle("Wire", false, switched("show_wire"), "Robots as lines from joint to joint"),
      reach: toggle("Reach", false, switched("show_reach"), "The space that the tool reaches"),
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
      heading("Obstacles", make("small", {}, "distances only; no method avoids them")),
      make("div", { class: "rk-buttons" }, SHAPES.map(add)),
      this.contact,
      this.obstacles,
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
    const { contact } = view;
    show(this.contact, contact !== null);
    if (contact) {
      const depth = (1e3 * contact.depth).toFixed(1);
      this.contact.textContent = `${contact.parts.join(" touches ")}: ${depth} mm deep`;
    }
    const names = view.obstacles.map(({ shape }, k) => `${shape} ${k + 1}`);
    refill(this.obstacles, names, () => names.map((name, k) => this.row(name, k)));
    view.obstacles.forEach(({ distance, part }, k) => {
      const cell = this.obstacles.rows[k].cells[1];
      const touches = distance !== null && distance < 0;
      cell.textContent = "far";
      if (touches) cell.textContent = `touches ${part}, ${(-1e3 * distance).toFixed(1)} mm deep`;
      else if (distance !== null) cell.textContent = `${(100 * distance).toFixed(1)} cm to ${part}`;
      cell.classList.toggle("rk-bad", touches);
    });
  }

  row(name, index) {
    const remove = button("trash", "", () => this.channel.command("remove_obstacle", { index }), {
      kind: "plain",
      title: `remove ${name}`,
    });
    return make(
      "tr",
      {},
      make("td", {}, name),
      make("td"),
      make("td", { class: "rk-narrow" }, remove),
    );
  }
}
