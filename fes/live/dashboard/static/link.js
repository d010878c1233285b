// The connection to the page's process: one web socket, opened again when it is lost, and the stop, which goes two ways.

const SECRET = "fes-secret";
const SILENT_MS = 1500; // the server says something every 400 ms

export class Link {
  /** @param {{hello: Function, frame: Function, said: Function, question: Function, refused: Function, lost: Function}} on */
  constructor(on) {
    this.on = on;
    this.wait = 200;
    this.heard = 0;
    this.token = location.hash.slice(1);
    if (this.token) history.replaceState(null, "", location.pathname); // used once; not for the address bar
    this.open();
    setInterval(() => this.watch(), 250);
  }

  open() {
    this.heard = performance.now();
    this.socket = new WebSocket(`ws://${location.host}/live`);
    this.socket.onopen = () => this.enter();
    this.socket.onmessage = (event) => this.take(JSON.parse(event.data));
    this.socket.onclose = () => this.again();
  }

  enter() {
    const secret = sessionStorage.getItem(SECRET) ?? "";
    if (this.token) this.send({ token: this.token });
    else if (secret) this.send({ secret });
    else this.on.refused("This page was opened without its link.");
  }

  take(said) {
    this.heard = performance.now();
    if (said.ended) this.over = true; // nobody will be there again
    if (said.hello) {
      sessionStorage.setItem(SECRET, said.secret);
      this.token = "";
      this.wait = 200;
      this.on.hello(said.hello);
    } else if (said.refused) {
      const used = this.token;
      this.token = "";
      // a link that was used in this very tab, then reloaded from the history: what it bought still counts
      if (used && sessionStorage.getItem(SECRET)) this.enter();
      else {
        sessionStorage.removeItem(SECRET);
        this.on.refused(said.refused);
      }
    } else if (said.question) this.on.question(said.question);
    else if (said.said) this.on.said(said.said);
    else this.on.frame(said);
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /** Emergency stop: over the socket, and as a request of its own should the socket be stuck. */
  stop() {
    const press = `${Date.now()}-${Math.random()}`.slice(0, 40); // the second to arrive is the same stop
    this.send({ ask: "stop", press });
    fetch(`/stop?press=${press}`, { method: "POST", keepalive: true }).catch(() => this.on.lost("stop"));
  }

  watch() {
    if (!this.over && sessionStorage.getItem(SECRET) && performance.now() - this.heard > SILENT_MS) this.on.lost("silent");
  }

  again() {
    if (this.over) return;
    this.on.lost("closed");
    setTimeout(() => this.open(), this.wait);
    this.wait = Math.min(this.wait * 2, 2000);
  }
}
