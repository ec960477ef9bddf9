// Helpers that build elements of the page.

/** Create an element with attributes and children. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "class") element.className = value;
    else if (name === "style") element.style.cssText = value;
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child != null));
  return element;
}

/** Outlines of the icons on a grid of 24 by 24. */
const PATHS = {
  arm: "M5 19h6M8 19v-5l5-4 4 3M13 10 11 5",
  box: "m12 3 8 4.5v9L12 21l-8-4.5v-9zM4 7.5l8 4.5 8-4.5M12 12v9",
  camera: "M4 8h4l2-2h4l2 2h4v11H4zM12 16a3 3 0 1 0 0-6 3 3 0 0 0 0 6z",
  cylinder: "M6 6c0-3 12-3 12 0v12c0 3-12 3-12 0zM6 6c0 3 12 3 12 0",
  down: "m6 9 6 6 6-6",
  film: "M4 5h16v14H4zM8 5v14M16 5v14M4 10h4M4 14h4M16 10h4M16 14h4",
  fit: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5",
  hand:
    "M8 12V6a1.5 1.5 0 0 1 3 0v5-6.5a1.5 1.5 0 0 1 3 0V11 6a1.5 1.5 0 0 1 3 0v8c0 4-2 6.5-5.5 6.5" +
    "S6.5 18 5 15l-1-2.2c-.6-1.3 1-2.3 2-1.3L8 14",
  help: "M9.2 9a3 3 0 1 1 4.2 2.8c-.9.4-1.4 1-1.4 2.2M12 17.5v.1",
  moon: "M20 14.5A8 8 0 0 1 9.5 4 8 8 0 1 0 20 14.5z",
  open: "M4 7h6l2 2h8v10H4z",
  panel: "M4 5h16v14H4zM14 5v14",
  pause: "M8 5v14M16 5v14",
  play: "M7 5v14l11-7z",
  record: "M12 5a7 7 0 1 0 0 14 7 7 0 0 0 0-14M12 10a2 2 0 1 0 0 4 2 2 0 0 0 0-4",
  reset: "M4 12a8 8 0 1 0 3-6.2M4 4v5h5",
  save: "M12 4v11m-4-4 4 4 4-4M5 20h14",
  share: "M12 15V4m-4 4 4-4 4 4M5 13v5a2 2 0 0 0 2 2h10a2 2 0 0 0 2-2v-5",
  pick: "M5 3l13 7-5.5 1.5L10 18zM13 13l6 6",
  plus: "M12 5v14M5 12h14",
  sphere: "M12 4a8 8 0 1 0 0 16 8 8 0 0 0 0-16M4 12c3 3 13 3 16 0",
  swap: "M7 4v14m-3-3 3 3 3-3M17 20V6m-3 3 3-3 3 3",
  trash: "M5 7h14M10 7V4h4v3m3 0-1 13H8L7 7",
};

/** Return an icon by name. */
export function icon(name) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("class", "rk-icon");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(space, "path");
  path.setAttribute("d", PATHS[name]);
  svg.append(path);
  return svg;
}

/** A button with an icon. */
export function button(name, label, act, { kind = "", title = "" } = {}) {
  const attributes = { class: `rk-btn ${kind}`, type: "button", title, onclick: act };
  if (!label) attributes["aria-label"] = title;
  return make("button", attributes, name ? icon(name) : null, label || null);
}

/** A heading of a group in the side panel. */
export function heading(text, ...children) {
  return make("div", { class: "rk-head" }, text, ...children);
}

/**
 * A row of buttons of which one is pressed.
 * @param options Value, label and title of each button.
 * @param act Called with the value of a button that was pressed.
 */
export function segmented(options, act, { small = false, label = "" } = {}) {
  const buttons = options.map(([value, text, title]) =>
    make(
      "button",
      { type: "button", title, "aria-pressed": "false", onclick: () => act(value) },
      text,
    ),
  );
  const kind = small ? "rk-seg small" : "rk-seg";
  const element = make("div", { class: kind, role: "group", "aria-label": label }, buttons);
  const set = (value) =>
    buttons.forEach((one, k) => one.setAttribute("aria-pressed", String(options[k][0] === value)));
  return { element, set };
}

/** A labelled switch. `set` shows a value. */
export function toggle(label, on, act, title = "") {
  const box = make("input", {
    type: "checkbox",
    role: "switch",
    "aria-label": label,
    onchange: () => act(box.checked),
  });
  box.checked = on;
  const element = make(
    "div",
    { class: "rk-row", title },
    make("label", {}, label),
    make("span", { class: "rk-switch" }, box, make("i")),
  );
  const set = (value) => {
    box.checked = value;
  };
  return { element, box, set };
}

/** A menu. `set` shows a value unless the menu is open. */
export function menu(options, act, { label = "", width = "" } = {}) {
  const select = make(
    "select",
    {
      class: "rk-num",
      style: `text-align:left;${width ? `width:${width}` : ""}`,
      "aria-label": label,
      onchange: () => {
        act(select.value);
        select.blur();
      },
    },
    options.map(([value, text]) => make("option", { value }, text)),
  );
  const set = (value) => {
    if (document.activeElement !== select) select.value = String(value);
  };
  return { element: select, set };
}

/** Replace the children of an element if the content has changed. */
export function refill(element, content, build) {
  const key = JSON.stringify(content);
  if (element.dataset.shown === key) return;
  element.dataset.shown = key;
  element.replaceChildren(...build());
}

/** Show or hide an element. */
export function show(element, visible) {
  element.classList.toggle("rk-hidden", !visible);
}

/** Save a file of this browser. */
export function download(name, bytes) {
  const url = URL.createObjectURL(new Blob([bytes]));
  make("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
