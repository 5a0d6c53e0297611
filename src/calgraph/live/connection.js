// The websocket to the session: states in, commands out, and connecting again after interruptions.

// The server sends something every few seconds (page.heartbeat in the settings): after this it is out of reach, ms.
const SILENCE = 8000;
// Pauses before connecting again, ms: short at first, as phones change between access points in a second.
const FIRST_PAUSE = 500;
const LONGEST_PAUSE = 8000;
// Close code of a server that is stopped (RFC 6455 and its registry): a lost link has none.
const STOPPED = 1012;

/**
 * Calls `onState` with the fields that have changed, and `onOffline` with the reason: "lost"; "ended", if the server
 * was stopped; "replaced", if another one, with another token, answers; empty when connected.
 */
export function connect(onState, onOffline) {
  let socket = null;
  let pause = FIRST_PAUSE;
  let watch = 0;
  let timer = 0;
  let reason = "";

  function open() {
    clearTimeout(timer);
    socket = new WebSocket(`ws://${location.host}/state`);
    expect();
    const opened = socket;
    opened.onmessage = (message) => {
      if (opened !== socket) return;
      expect();
      pause = FIRST_PAUSE;
      report("");
      onState(JSON.parse(message.data));
    };
    opened.onclose = (event) => {
      if (opened === socket) again(event.code === STOPPED);
    };
  }

  function expect() {
    clearTimeout(watch);
    watch = setTimeout(again, SILENCE);
  }

  function report(found) {
    reason = found;
    onOffline(found);
  }

  async function again(isStopped = false) {
    clearTimeout(watch);
    const lost = socket;
    socket = null;
    lost?.close();
    timer = setTimeout(open, pause * (0.75 + Math.random() / 2));
    pause = Math.min(LONGEST_PAUSE, 2 * pause);
    // Later attempts that fail have no other reason.
    if (!reason) report(isStopped ? "ended" : "lost");
    // A refused websocket gives no reason; a refused file does.
    const answer = await fetch("/page.css").catch(() => null);
    if (answer?.status === 403 && !socket) report("replaced");
  }

  const hurry = () => {
    if (socket) return;
    pause = FIRST_PAUSE;
    open();
  };
  window.addEventListener("online", hurry);
  window.addEventListener("offline", () => socket && again());
  document.addEventListener("visibilitychange", () => {
    if (document.visibilityState === "visible") hurry();
  });
  open();

  /** Whether the command left the page. */
  return function send(action) {
    if (socket?.readyState !== WebSocket.OPEN) return false;
    socket.send(action);
    return true;
  };
}
