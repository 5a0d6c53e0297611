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
  let reason = "";
  // End the connection, and the pause before the next one.
  let abandon = () => {};
  let hurry = () => {};

  function report(found) {
    reason = found;
    onOffline(found);
  }

  /** Receives until the connection is closed or silent; the code of its end. */
  const receive = () => new Promise((end) => {
    let watch = setTimeout(end, SILENCE);
    abandon = end;
    socket.onclose = (event) => end(event.code);
    socket.onmessage = (message) => {
      clearTimeout(watch);
      watch = setTimeout(end, SILENCE);
      pause = FIRST_PAUSE;
      report("");
      onState(JSON.parse(message.data));
    };
  });

  async function run() {
    for (;;) {
      socket = new WebSocket(`ws://${location.host}/state`);
      const code = await receive();
      socket.onmessage = null;
      socket.close();
      // Later attempts that fail have no other reason.
      if (!reason) report(code === STOPPED ? "ended" : "lost");
      // A refused websocket gives no reason; a refused file does.
      fetch("/page.css").then((answer) => reason && answer.status === 403 && report("replaced"), () => {});
      const wait = pause * (0.75 + Math.random() / 2);
      pause = Math.min(LONGEST_PAUSE, 2 * pause);
      await new Promise((next) => {
        hurry = next;
        setTimeout(next, wait);
      });
    }
  }

  const connectNow = () => {
    pause = FIRST_PAUSE;
    hurry();
  };
  window.addEventListener("online", connectNow);
  window.addEventListener("offline", () => abandon());
  document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && connectNow());
  run();

  /** Whether the command left the page. */
  return function send(action) {
    if (socket.readyState !== WebSocket.OPEN) return false;
    socket.send(action);
    return true;
  };
}
