// The websocket to the session: states in, commands out, and connecting again after interruptions.

// The server sends something every few seconds (page.heartbeat in the settings): after this it is out of reach, ms.
const SILENCE = 8000;
// Pauses before connecting again, ms: short at first, as phones change between access points in a second.
const FIRST_PAUSE = 500;
const LONGEST_PAUSE = 8000;

/** Calls `onState` with the fields that have changed, and `onOffline` with a text, empty when connected. */
export function connect(onState, onOffline) {
  let socket = null;
  let pause = FIRST_PAUSE;
  let watch = 0;
  let timer = 0;

  function open() {
    clearTimeout(timer);
    socket = new WebSocket(`ws://${location.host}/state`);
    expect();
    const opened = socket;
    opened.onmessage = (message) => {
      if (opened !== socket) return;
      expect();
      pause = FIRST_PAUSE;
      onOffline("");
      onState(JSON.parse(message.data));
    };
    opened.onclose = () => {
      if (opened === socket) again();
    };
  }

  function expect() {
    clearTimeout(watch);
    watch = setTimeout(again, SILENCE);
  }

  async function again() {
    clearTimeout(watch);
    const lost = socket;
    socket = null;
    lost?.close();
    timer = setTimeout(open, pause * (0.75 + Math.random() / 2));
    pause = Math.min(LONGEST_PAUSE, 2 * pause);
    onOffline("No connection to calgraph: connecting again. Recording does not depend on this page.");
    // A refused websocket gives no reason; a refused file does.
    const answer = await fetch("/page.css").catch(() => null);
    if (answer?.status === 403 && !socket) onOffline("The session has ended: open the link that is shown now.");
  }

  const hurry = () => {
    if (socket) return;
    pause = FIRST_PAUSE;
    open();
  };
  window.addEventListener("online", hurry);
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
