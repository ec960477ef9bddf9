// The page's WebSocket, on a worker: a page that draws slowly still reads and stays connected.
// Changes of the view are merged until the page has shown the ones before. Pictures are decoded and
// drawn here.
"use strict";

const RETRY_MS = 1000;
const BEAT_MS = 1000;
const HEADER_BYTES = 16; // before a JPEG: number, time, width, height

let socket = null;
let canvas = null;
let context = null;
let changes = null; // of the view, not shown yet
let isFree = true; // the page has shown the changes before
let hasView = false; // since the last beat

function connect(url) {
  socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => postMessage({ open: true });
  socket.onclose = () => {
    postMessage({ lost: true });
    setTimeout(connect, RETRY_MS, url);
  };
  socket.onmessage = ({ data }) => {
    if (data instanceof ArrayBuffer) {
      draw(data);
      return;
    }
    const message = JSON.parse(data);
    if (!message.view) {
      postMessage(message);
      return;
    }
    hasView = true;
    changes = { ...changes, ...message.view };
    pass();
  };
}

/** Hand on the changes of the view when the page has shown the ones before. */
function pass() {
  if (!isFree || !changes) return;
  isFree = false;
  postMessage({ view: changes });
  changes = null;
}

async function draw(data) {
  const header = new DataView(data);
  const number = header.getUint32(0, true);
  const time = header.getFloat64(4, true);
  const jpeg = new Blob([new Uint8Array(data, HEADER_BYTES)], { type: "image/jpeg" });
  const bitmap = await createImageBitmap(jpeg);
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  send({ shown: number });
  postMessage({ picture: { number, age: Date.now() / 1e3 - time } });
}

function send(message) {
  if (socket !== null && socket.readyState === WebSocket.OPEN) {
    socket.send(JSON.stringify(message));
  }
}

// A beat shows that the program's loop, its server and the connection work.
setInterval(() => {
  if (hasView) postMessage({ beat: true });
  hasView = false;
}, BEAT_MS);

onmessage = ({ data }) => {
  if (data.connect) {
    connect(data.connect);
  } else if (data.canvas) {
    canvas = data.canvas;
    context = canvas.getContext("2d", { alpha: false });
  } else if (data.next) {
    isFree = true;
    pass();
  } else {
    send(data.send);
  }
};
