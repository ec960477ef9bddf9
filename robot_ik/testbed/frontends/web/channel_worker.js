// The page's WebSocket, on a worker: a page that draws slowly still reads and stays connected.
// Changes of the view are merged until the page has shown the ones before.
"use strict";

const RETRY_MS = 1000;
const BEAT_MS = 1000;
const HEADER_BYTES = 28; // before a JPEG: number, time, width, height, ball (u, v, radius)

let socket = null;
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
      postMessage({ picture: pictureOf(data) });
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

/** Number, time and ball of a picture, and its JPEG. */
function pictureOf(data) {
  const head = new DataView(data);
  return {
    number: head.getUint32(0, true),
    taken: head.getFloat64(4, true),
    ball: [16, 20, 24].map((at) => head.getFloat32(at, true)),
    jpeg: new Blob([new Uint8Array(data, HEADER_BYTES)], { type: "image/jpeg" }),
  };
}

/** Hand on the changes of the view when the page has shown the ones before. */
function pass() {
  if (!isFree || !changes) return;
  isFree = false;
  postMessage({ view: changes });
  changes = null;
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
  } else if (data.next) {
    isFree = true;
    pass();
  } else {
    send(data.send);
  }
};
