// The page's life: the stream of pictures, what to do when it ends, and the switches.
import { draw } from "./draw.js";
import { advance, settings } from "./settings.js";

const SILENCE = 3000;  // ms: the server sends at least every second
const AGAIN = 1000;  // ms between attempts
let source = null;
let picture = null;
let problem = null;
let build = null;
let heard = [0, 0];  // ms when the last picture came, by two clocks: one of them may stand still while the device sleeps
let tried = 0;

function show() {
  draw(picture, problem);
}

function fail(what) {
  picture = null;
  problem = what;
  show();
}

function close() {
  source?.close();
  source = null;
}

function open() {
  close();
  tried = performance.now();
  const own = new EventSource("api/stream");
  source = own;
  own.addEventListener("build", (event) => {
    if (build && build !== event.data) location.reload();  // the server was started anew, with another page
    build = event.data;
    heard = [performance.now(), Date.now()];
  });
  own.addEventListener("message", (event) => {
    if (own !== source) return;
    heard = [performance.now(), Date.now()];
    try {
      picture = JSON.parse(event.data);
      problem = null;
      show();
    } catch (error) {
      console.error(error);
      fail("hung");
    }
  });
  own.addEventListener("error", () => {
    if (own !== source) return;
    close();  // tried again below, also where the browser itself would not
    fail("gone");
  });
}

function look() {
  const now = performance.now();
  const quiet = Math.max(now - heard[0], Math.abs(Date.now() - heard[1])) > SILENCE;
  if (source && quiet && now - tried > SILENCE) {
    close();
    fail("hung");
  }
  if (!source && !document.hidden && now - tried > AGAIN) open();
  if (picture || problem) show();  // what is read out waits until it has settled
}

document.addEventListener("visibilitychange", () => {
  if (!document.hidden) return open();
  close();  // nobody looks: leave the connection to others
  picture = null;
  problem = null;
  return draw(null, null);
});
window.addEventListener("pagehide", close);
window.addEventListener("pageshow", (event) => { if (event.persisted) open(); });
for (const name of ["theme", "unit", "language"]) {
  document.getElementById(name).addEventListener("click", () => {
    advance(name);
    if (name === "theme") window.chooseTheme(settings.theme);
    show();
  });
}
draw(null, null);
open();
setInterval(look, 500);
