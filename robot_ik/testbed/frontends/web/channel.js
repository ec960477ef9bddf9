// The connection to the program: commands out, views in. A worker holds the WebSocket.

const CHANNEL = "/testbed/channel";

export class Channel {
  /** @param on Functions by the name of a message. */
  constructor(on) {
    const url = new URL(CHANNEL, location.href);
    url.search = "";
    url.protocol = url.protocol.replace("http", "ws");
    this.worker = new Worker("/testbed/channel_worker.js");
    this.worker.onmessage = ({ data }) => {
      for (const [name, value] of Object.entries(data)) on[name]?.(value);
      if (data.view) requestAnimationFrame(() => this.worker.postMessage({ next: true }));
    };
    this.worker.postMessage({ connect: url.href });
  }

  send(message) {
    this.worker.postMessage({ send: message });
  }

  /** Send a command of the command log. */
  command(name, values = {}) {
    this.send({ command: name, ...values });
  }

  /** Send an action, which is not in the command log. */
  action(name, values = {}) {
    this.send({ action: name, ...values });
  }
}
