// What an operator notices without reading: sounds, vibration, a flash of the screen.

import { byId } from "./dom.js";

// Frequency in Hz, start and duration in s, waveform: rising for taken, low and twice for refused.
const SOUNDS = {
  taken: [[660, 0, 0.12, "sine"], [990, 0.12, 0.22, "sine"]],
  refused: [[196, 0, 0.16, "square"], [165, 0.22, 0.3, "square"]],
  pressed: [[1200, 0, 0.03, "sine"]],
  done: [[523, 0, 0.14, "sine"], [659, 0.14, 0.14, "sine"], [784, 0.28, 0.14, "sine"], [1047, 0.42, 0.4, "sine"]],
};
const VIBRATIONS = { taken: [180], refused: [60, 70, 60, 70, 60], pressed: [25], done: [200, 80, 200, 80, 400] };
const LOUDNESS = 0.35;

let audio = null;

/** Browsers permit sounds and vibration after the first touch or key. */
export function startFeedback() {
  const start = () => {
    const Audio = window.AudioContext ?? window.webkitAudioContext;
    if (!audio && Audio) audio = new Audio();
    audio?.resume();
  };
  for (const kind of ["pointerdown", "keydown"]) window.addEventListener(kind, start, { passive: true });
  document.addEventListener("visibilitychange", () => {
    if (document.visibilityState === "visible" && audio) start();
  });
}

/** Sound and vibration; before the first touch, neither. */
export function signal(kind) {
  document.body.dataset.signal = kind;
  if (!audio) return;
  navigator.vibrate?.(VIBRATIONS[kind]);
  for (const note of SOUNDS[kind]) playNote(...note);
}

function playNote(frequency, delay, duration, type) {
  const start = audio.currentTime + delay;
  const oscillator = new OscillatorNode(audio, { frequency, type });
  const gain = new GainNode(audio, { gain: 0 });
  // Ramps instead of steps: a step clicks.
  gain.gain.setValueAtTime(0, start);
  gain.gain.linearRampToValueAtTime(type === "square" ? LOUDNESS / 2 : LOUDNESS, start + 0.01);
  gain.gain.setValueAtTime(type === "square" ? LOUDNESS / 2 : LOUDNESS, start + duration - 0.01);
  gain.gain.linearRampToValueAtTime(0, start + duration);
  oscillator.connect(gain).connect(audio.destination);
  oscillator.start(start);
  oscillator.stop(start + duration);
}

/** Colours the whole screen for a moment. */
export function flash(kind) {
  const layer = byId("flash");
  layer.className = "";
  // Reading a size makes the browser notice that the class was removed: the animation begins again.
  void layer.offsetWidth;
  layer.className = kind;
}
