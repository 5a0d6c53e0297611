// The page of a live session: shows its state, and sends what the operator presses.

import { connect } from "./connection.js";
import { byId, formatCount, formatTime, make, setOptionalText, setPicture, setText } from "./dom.js";
import { flash, signal, startFeedback } from "./feedback.js";
import { showScene } from "./scene.js";
import { showSensors } from "./sensors.js";

const CAPTURING = new Set(["ready", "waiting", "measuring"]);
const ENDING = new Set(["finishing", "finished", "failed"]);
// Longer sentences are set in smaller letters.
const LONG = 60;
const OFFLINE = {
  "": "",
  lost: "No connection to calgraph live: connecting again. Recording does not depend on this page.",
  ended: "calgraph live has ended on the computer. This page connects again if the session is resumed.",
  replaced: "calgraph live was started again with another link: open the link that it shows now.",
  over: "calgraph live has ended on the computer: the result is in the folder of the session.",
};
const END_SIGNALS = { finished: "done", failed: "refused" };
const LABELS = { waiting: "Hold still", measuring: "Measuring", background: "Wait", connecting: "Wait" };

const SPACE_TITLES = { rig: "Sensors and boards", network: "Floor plan", drive: "Poses" };
const ADVICE_TITLES = { rig: "Next board pose", network: "Next walk", drive: "What to drive" };

let state = null;

const send = connect((changes) => {
  const before = state;
  state = { ...state, ...changes };
  if (state.kind) show(before);
}, showOffline);

startFeedback();

function show(before) {
  document.body.dataset.phase = state.phase;
  document.body.dataset.kind = state.kind;
  document.body.dataset.done = state.done ? "yes" : "no";
  showSource();
  setText(byId("headline"), state.headline);
  byId("headline").classList.toggle("long", state.headline.length > LONG);
  setText(byId("sensors-title"), state.kind === "network" ? "Scanners" : "Sensors");
  setText(byId("space-title"), SPACE_TITLES[state.kind]);
  showEvent(before);
  showOverall();
  showAdvice();
  showNeeds();
  showSensors(state);
  showScene(state);
  showRecorder();
  showControls();
}

/** Once the recording has ended, it does not matter whether its source is connected. */
function showSource() {
  const isOver = ENDING.has(state.phase);
  byId("status").className = isOver ? "over" : state.connected ? "connected" : "";
  setText(byId("source"), isOver || state.connected ? state.source : `Not connected: ${state.source}`);
}

/** A page that was opened or reloaded is silent about what happened before. */
function showEvent(before) {
  const { number, taken, text } = state.event;
  setOptionalText(byId("event"), number && !ENDING.has(state.phase) ? text : "");
  byId("event").className = taken ? "taken" : "";
  byId("event").classList.toggle("long", text.length > LONG);
  if (before?.event && number > before.event.number) announce(taken ? "taken" : "refused");
  if (before?.event && state.done && !before.done && !ENDING.has(state.phase)) announce("done");
  if (before?.event && state.phase !== before.phase && END_SIGNALS[state.phase]) announce(END_SIGNALS[state.phase]);
}

function announce(kind) {
  signal(kind);
  flash(kind);
}

function showOverall() {
  const segments = byId("segments");
  while (segments.children.length > state.sensors.length) segments.lastChild.remove();
  while (segments.children.length < state.sensors.length) segments.append(make("li", "", make("span")));
  let within = 0;
  state.sensors.forEach((sensor, index) => {
    const isWithin = sensor.progress >= 1;
    segments.children[index].className = isWithin ? "within" : "";
    segments.children[index].firstChild.style.width = `${100 * sensor.progress}%`;
    if (isWithin && sensor.name !== state.root) within += 1;
  });
  const others = state.sensors.filter((sensor) => sensor.name !== state.root).length;
  const noun = state.kind === "network" ? "scanners" : "sensors";
  const parts = [`${within} of ${others} ${noun} within tolerance`];
  if (state.kind === "rig") parts.unshift(formatCount(state.captures, "capture"));
  setText(byId("summary"), parts.join(" · "));
}

function showAdvice() {
  const { advice } = state;
  byId("advice").hidden = !advice || state.done || ENDING.has(state.phase);
  if (!advice) return;
  setText(byId("advice-title"), ADVICE_TITLES[state.kind]);
  setText(byId("advice-text"), advice.text);
  setOptionalText(byId("advice-expected"), advice.expected);
  setPicture(byId("advice-picture"), advice.picture);
  setPicture(byId("large-picture"), advice.picture);
  byId("enlarge").hidden = !advice.picture;
}

/** What a drive has of what it needs, as bars. */
function showNeeds() {
  const list = byId("needs");
  while (list.children.length > state.needs.length) list.lastChild.remove();
  while (list.children.length < state.needs.length) {
    list.append(make("li", "", make("span"), make("span", "amount"), make("div", "bar", make("span"))));
  }
  state.needs.forEach(({ label, text, progress, optional }, index) => {
    const item = list.children[index];
    item.className = progress >= 1 ? "within" : "";
    setText(item.children[0], optional ? `${label} (if the floor permits)` : label);
    setText(item.children[1], text);
    item.children[2].firstChild.style.width = `${100 * Math.min(progress, 1)}%`;
  });
}

function showRecorder() {
  const { seconds, megabytes, messages, lost, gaps, minutes_left: left, problem } = state.recorder;
  const parts = [
    formatTime(seconds),
    `${megabytes.toLocaleString("en", { maximumFractionDigits: megabytes < 10 ? 1 : 0 })} MB`,
    formatCount(messages, "message"),
    `${lost.toLocaleString("en")} lost`,
  ];
  if (gaps) parts.push(`${formatCount(gaps, "gap")} in the connection`);
  if (left !== null) parts.push(left < 600 ? `disk full in ${Math.floor(left)} min` : "enough disk space");
  setText(byId("recorder"), parts.join(" · "));
  setOptionalText(byId("recorder-problem"), problem);
  const notices = byId("notices");
  const key = state.notices.join("\n");
  if (notices.dataset.shown === key) return;
  notices.dataset.shown = key;
  notices.replaceChildren(...state.notices.map((text) => make("li", "", text)));
}

function showControls() {
  byId("automatic").setAttribute("aria-pressed", state.automatic);
  byId("manual").setAttribute("aria-pressed", !state.automatic);
  byId("trigger").disabled = !CAPTURING.has(state.phase);
  const isDrive = state.kind === "drive";
  if (isDrive && state.phase === "waiting") byId("trigger").disabled = true;
  setText(byId("trigger-label"), isDrive ? "Calibrate" : LABELS[state.phase] ?? "Capture");
  setText(byId("trigger-note"), isDrive ? "what was recorded so far, and drive on" : describeTrigger());
  byId("discard").disabled = state.captures === 0;
  byId("report").hidden = !state.report;
}

function describeTrigger() {
  if (state.phase === "waiting") return "press again to capture while it moves";
  if (state.phase === "ready") return state.automatic ? "or hold the board still" : "press, then hold still";
  return "";
}

function showOffline(reason) {
  document.body.dataset.page = reason ? "offline" : "online";
  const isOver = state && END_SIGNALS[state.phase];
  setOptionalText(byId("offline"), OFFLINE[isOver && reason === "ended" ? "over" : reason]);
}

function press(action) {
  if (send(action)) {
    signal("pressed");
    return;
  }
  announce("refused");
}

for (const action of ["trigger", "automatic", "manual"]) byId(action).addEventListener("click", () => press(action));

const ask = (question, answer, action, isSevere) => {
  setText(byId("question"), question);
  setText(byId("yes"), answer);
  byId("yes").className = isSevere ? "severe" : "";
  byId("yes").onclick = () => {
    byId("confirm").close();
    press(action);
  };
  byId("confirm").showModal();
};
byId("no").addEventListener("click", () => byId("confirm").close());
byId("discard").addEventListener("click", () => {
  ask(`Leave out the last capture? ${formatCount(state.captures - 1, "capture")} remain.`, "Leave out", "discard", true);
});
byId("finish").addEventListener("click", () => {
  const open = state.done ? "" : "Not all are within tolerance yet. ";
  ask(`${open}End the recording and calibrate?`, "Finish", "finish", false);
});

byId("enlarge").addEventListener("click", () => byId("enlarged").showModal());
byId("reduce").addEventListener("click", () => byId("enlarged").close());

// Space is the trigger wherever the focus is, except on buttons and links, which it presses.
window.addEventListener("keydown", (event) => {
  const isOnControl = event.target.closest?.("button, a, dialog");
  if (event.code !== "Space" || event.repeat || isOnControl || byId("confirm").open) return;
  event.preventDefault();
  if (state?.kind !== "network" && !byId("trigger").disabled) press("trigger");
});
