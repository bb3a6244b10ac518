// The socket: messages out, messages in, and one sentence where something is wrong.

const ALIVE_EVERY = 500;

export class Link {
  constructor(hear, tell) {
    this.hear = hear;
    this.tell = tell;
    this.delay = 300;
    this.stopped = false;
    setInterval(() => this.send({ t: "alive" }), ALIVE_EVERY);
    this.open();
  }

  get isOpen() { return this.socket?.readyState === WebSocket.OPEN; }

  open() {
    const address = new URL("./socket", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    this.socket = new WebSocket(address);
    this.socket.onopen = () => { this.delay = 300; this.tell(null); };
    this.socket.onmessage = (event) => this.hear(JSON.parse(event.data));
    this.socket.onclose = (event) => this.closed(event);
  }

  closed(event) {
    if (event.code === 1008 && event.reason !== "refused") {
      this.tell(`The server has closed the connection: ${event.reason}. Everything recorded is kept; connecting again …`);
      this.delay = 2500;
    } else if (event.code === 1012 || event.code === 1001) {
      this.tell("The server has stopped. Everything recorded is kept; start “misstep live” again and this page goes on by itself.");
    } else {
      this.tell("The connection to the server is lost. Everything recorded is kept; trying to connect again …");
    }
    setTimeout(() => this.open(), this.delay);
    this.delay = Math.min(this.delay * 1.6, 2000);
  }

  send(message) {
    if (this.isOpen) this.socket.send(JSON.stringify(message));
    return this.isOpen;
  }
}

// What the server says against a request; it may be no sentence of ours.
export async function problemOf(answer) {
  const told = await answer.json().catch(() => ({}));
  return told.problem ?? "the server refused";
}

export async function getJson(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(await problemOf(answer));
  return answer.json();
}

export async function upload(file) {
  const answer = await fetch(`./api/upload?name=${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
  if (!answer.ok) throw new Error(await problemOf(answer));
  return (await answer.json()).added;
}
