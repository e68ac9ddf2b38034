// The connection to the panel: the live state, and the requests of this page.
//
// The state arrives on a WebSocket; every few states are confirmed, so that the panel knows that this page is there.
// Requests are POSTs of their own: Let down works while the WebSocket is down.

const CONFIRM_EVERY = 3; // states
const SILENCE = 1500; // ms without a state after which the values on the page are old
const RETRY = 500; // ms
const ANSWER = 2500; // ms that Let down waits for its answer
const READ = 5000; // ms that the arm's settings are waited for
const [FULL, REPLACED] = [4000, 4001];

let secret = sessionStorage.getItem("page") || "";
let socket = null;
let newest = 0;

export const link = { number: 0, alive: false, full: false };

export function connect(handlers) {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.onopen = () => socket.send(JSON.stringify({ page: secret }));
  socket.onmessage = (event) => take(JSON.parse(event.data), handlers);
  socket.onclose = (event) => {
    link.full = event.code === FULL;
    if (event.code === REPLACED) keep(""); // this tab was copied: it becomes a page of its own
    setTimeout(() => connect(handlers), RETRY);
  };
}

export function watch(onChange) {
  setInterval(() => {
    const alive = performance.now() - newest < SILENCE && newest > 0;
    if (alive !== link.alive) {
      link.alive = alive;
      onChange();
    }
  }, 200);
}

function keep(value) {
  secret = value;
  sessionStorage.setItem("page", value);
}

function take(message, handlers) {
  if (message.type === "page") {
    keep(message.page);
    link.number = message.number;
  }
  if (message.type === "state") {
    newest = performance.now();
    link.alive = true;
    if (message.number % CONFIRM_EVERY === 0) socket.send(JSON.stringify({ seen: message.number }));
  }
  handlers[message.type]?.(message);
}

// Sends a request. Returns "" or why it was not carried out; null if there was no answer.
export async function request(body, timeout = 8000) {
  try {
    const answer = await fetch("/action", {
      method: "POST",
      headers: { "content-type": "application/json", "x-panel-page": secret },
      body: JSON.stringify(body),
      keepalive: true,
      signal: AbortSignal.timeout(timeout),
    });
    const text = (await answer.text()) || answer.statusText;
    try {
      return JSON.parse(text).error;
    } catch {
      return text;
    }
  } catch {
    return null;
  }
}

// The arm's settings at this moment, read from its compensator: {settings}, or {error}.
export async function settingsOf(arm) {
  try {
    const answer = await fetch(`/settings/${arm.split("/").map(encodeURIComponent).join("/")}`, { signal: AbortSignal.timeout(READ) });
    return await answer.json();
  } catch (error) {
    return { error: String(error) };
  }
}

export const letDown = (arm) => request(arm ? { do: "let_down", arm } : { do: "let_down" }, ANSWER);
