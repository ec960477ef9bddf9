// The page around viser's 3D view: its parts, and the messages that each part shows.

import { ArPane, ArTab } from "./ar.js";
import { ArmTab } from "./arm.js";
import { CameraPane } from "./camera.js";
import { Channel } from "./channel.js";
import { Connection } from "./connection.js";
import { ContactLabels } from "./contact_labels.js";
import { Gallery, Intro, KeyList } from "./dialogs.js";
import { button, download, make } from "./dom.js";
import { GoalsTab } from "./goals.js";
import { JointsTab } from "./joints.js";
import { Keys, isMove, worldStep } from "./keys.js";
import { Labels } from "./labels.js";
import { MethodsTab } from "./methods.js";
import { Overlay } from "./overlay.js";
import { RecordTab } from "./record.js";
import { SceneTab } from "./scene_tab.js";
import { TimeLine } from "./timeline.js";
import { TopBar } from "./top_bar.js";

const PAIRING_MS = 500; // between two searches for the key of this page
const PAGE_NODE = "/page/"; // viser names an empty node by the key
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;

class Page {
  constructor() {
    this.view = null;
    this.settings = null;
    this.role = null;
    this.key = "";
    this.tabs = null;
    this.connection = new Connection();
    this.overlay = new Overlay();
    this.channel = new Channel({
      open: () => {
        this.key = ""; // it must be sent again on the new connection
      },
      lost: () => this.connection.closed(),
      beat: () => this.connection.beat(),
      program: (value) => this.showProgram(value),
      robot: (value) => this.showRobot(value),
      settings: (value) => this.showSettings(value),
      role: (value) => this.showRole(value),
      reach: (value) => this.showReach(value),
      view: (value) => this.showView(value),
      camera: (value) => this.camera.show(value),
      picture: (value) => {
        const pane = this.settings?.ar.on ? this.ar : this.camera;
        pane.showPicture(value);
      },
      ar: (value) => this.showArStatus(value),
      cases: (value) => this.showCases(value),
      notice: (value) => this.overlay.notice(value),
      file: ({ name, base64 }) => {
        download(name, Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)));
        this.overlay.notice(`Saved ${name}`);
      },
    });
    this.camera = new CameraPane(this.channel);
    this.ar = new ArPane(this.channel);
    this.timeline = new TimeLine(this.channel);
    this.top = new TopBar(this.channel, {
      stop: () => this.stop(),
      start: () => this.channel.action("press_key", { code: "Space" }),
      reset: () => this.channel.command("reset"),
      robots: () => this.gallery?.open(),
      help: () => this.keyList?.open(),
      theme: () => this.channel.action("set_theme", { dark: !this.settings?.dark }),
      camera: () => this.switchCamera(),
    });
    this.side = make("aside", { class: "rk-side" });
    this.fold = button("panel", "", () => this.switchPanel(), {
      kind: "rk-fold",
      title: "Hide or show the panel (\\)",
    });
    this.root = make(
      "div",
      { id: "rk" },
      this.camera.element,
      this.ar.element,
      this.overlay.elements,
      this.side,
      this.fold,
      this.timeline.element,
      this.top.element,
      this.connection.element,
    );
    document.body.append(this.root);
    document.title = "robot_ik testbed";
    setInterval(() => this.pair(), PAIRING_MS);
  }

  /** STOP: everything holds still. */
  stop() {
    this.channel.command("set_running", { running: false });
  }

  switchCamera() {
    this.channel.action("show_camera", { on: !this.settings?.camera });
  }

  switchAr() {
    this.channel.action("show_ar", { on: !this.settings?.ar.on });
  }

  showArStatus(status) {
    this.arStatus = status;
    this.ar.showStatus(status);
    this.tabs?.AR.showStatus(status);
  }

  switchPanel() {
    document.body.classList.toggle("rk-wide");
  }

  /** Tell the program which connection of viser belongs to this page. */
  pair() {
    const names = Object.keys(window.__viserMutable?.nodeRefFromName ?? {});
    const node = names.findLast((name) => name.startsWith(PAGE_NODE));
    const key = node?.slice(PAGE_NODE.length) ?? "";
    if (!key || key === this.key) return;
    this.key = key;
    this.channel.send({ page: key });
    this.channel.action("report_graphics", { software: drawsInSoftware() });
  }

  /** Build the parts that depend on the program. The message comes again after a reconnection. */
  showProgram(program) {
    this.connection.withArm = program.arm;
    this.top.showProgram(program);
    if (this.tabs) return;
    this.labels = new Labels(program.colours);
    this.contactLabels = new ContactLabels();
    this.gallery = new Gallery(program, this.channel);
    this.intro = new Intro(() => this.gallery.open());
    this.keyList = new KeyList(program.keys);
    this.dialogs = [this.gallery, this.intro, this.keyList];
    this.tabs = {
      Methods: new MethodsTab(program, this.channel),
      Joints: new JointsTab(program, this.channel),
      Goals: new GoalsTab(this.channel),
      Arm: new ArmTab(this.channel),
      AR: new ArTab(this.channel),
      Scene: new SceneTab(this.channel, (text) => this.overlay.notice(text)),
      Record: new RecordTab(program, this.channel),
    };
    this.dialogs.push(this.tabs.Methods.theses.table);
    this.buildSide();
    this.root.prepend(this.labels.element, this.contactLabels.element);
    this.root.append(...this.dialogs.map(({ element }) => element));
    this.listenToKeys(program.keys);
    this.intro.openOnce();
    if (this.robot) this.showRobot(this.robot);
    if (this.settings) this.showSettings(this.settings);
    if (this.role) this.showRole(this.role);
    if (this.reach) this.showReach(this.reach);
    if (this.arStatus) this.showArStatus(this.arStatus);
    if (this.cases) this.showCases(this.cases);
    if (this.view) this.draw();
  }

  buildSide() {
    const body = make("div", { class: "rk-body" });
    const choose = (name) => {
      this.tab = name;
      for (const tab of buttons) {
        tab.setAttribute("aria-selected", String(tab.textContent === name));
      }
      body.replaceChildren(this.tabs[name].element);
      if (this.view) this.draw();
    };
    const buttons = Object.keys(this.tabs).map((name) =>
      make("button", { type: "button", role: "tab", onclick: () => choose(name) }, name),
    );
    this.side.append(make("div", { class: "rk-tabs", role: "tablist" }, buttons), body);
    choose("Methods");
  }

  listenToKeys(keys) {
    const actions = {};
    for (const { code, command } of keys) {
      if (command && !isMove(code)) {
        actions[code] = () => this.channel.action("press_key", { code });
      }
    }
    Object.assign(actions, {
      Escape: () => this.escape(),
      KeyL: () => this.channel.action("show_overlay", { on: !this.settings?.overlay }),
      KeyV: () => this.switchCamera(),
      KeyX: () => this.switchAr(),
      KeyG: () => this.gallery.open(),
      Backslash: () => this.switchPanel(),
      Slash: () => this.keyList.open(),
    });
    const nudge = (step) => {
      const asSeen = !this.view?.figure && !this.settings?.ar.on;
      this.channel.command("nudge", { step: asSeen ? worldStep(step) : step });
    };
    const isDialogOpen = () => this.dialogs.some((dialog) => dialog.isOpen);
    this.keys = new Keys(actions, nudge, isDialogOpen);
    this.keys.onmode = (on) => {
      this.overlay.notice(on ? "Keys move the camera" : "Keys move the ball");
    };
  }

  /** Close a dialog, or STOP. */
  escape() {
    const open = this.dialogs.find((dialog) => dialog.isOpen);
    if (open) open.close();
    else this.stop();
  }

  showRobot(robot) {
    this.robot = robot;
    this.overlay.showRobot(robot);
    this.top.showRobot(robot);
    this.tabs?.Joints.showRobot(robot);
    this.tabs?.Goals.showRobot(robot);
    this.gallery?.showRobot(robot);
  }

  showSettings(settings) {
    this.settings = settings;
    this.overlay.showSettings(settings);
    this.camera.showSettings(settings);
    this.ar.showSettings(settings.ar);
    this.top.showSettings(settings);
    this.tabs?.AR.showSettings(settings.ar);
    this.tabs?.Scene.showSettings(settings);
    this.tabs?.Goals.showSettings(settings);
    document.documentElement.classList.toggle("rk-dark", settings.dark);
    document.body.toggleAttribute("data-rk-camera", settings.camera);
    document.body.dataset.rkAr = settings.ar.on ? settings.ar.place : "off";
  }

  showCases(cases) {
    this.cases = cases;
    this.tabs?.Methods.theses.showCases(cases);
  }

  showRole(role) {
    this.role = role;
    this.overlay.showRole(role);
    this.tabs?.Scene.showRole(role);
  }

  showReach(reach) {
    this.reach = reach;
    this.tabs?.Scene.reach.showReach(reach);
  }

  showView(changes) {
    this.view = { ...this.view, ...changes };
    if (this.tabs) this.draw();
  }

  draw() {
    const { view } = this;
    this.top.show(view);
    this.overlay.show(view, this.keys?.movesCamera ?? false, this.settings?.ar.on ?? false);
    this.labels.show(view, this.settings?.overlay ?? true);
    this.contactLabels.show(view);
    this.timeline.show(view.timeline);
    for (const [name, tab] of Object.entries(this.tabs)) {
      if (name === "Methods") tab.show(view, this.tab === name);
      else if (this.tab === name) tab.show(view);
    }
    document.body.toggleAttribute("data-rk-several", view.instances.length > 1);
  }
}

/** Whether this browser draws without a GPU. */
function drawsInSoftware() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) return true;
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(name);
}

new Page();
