// What the rider must know: shown while it holds, and read out once when it begins.
import { DASH, distance, known, number, percent } from "./numbers.js";
import { said, word, words } from "./words.js";

const NOTES = ["waiting"];
const WARNINGS = ["destination_uncertain", "sensor_lost", "partly_silent", "cell_too_cold"];  // the others are critical
const SETTLED = 1500;  // ms that something holds before it is read out
const AGAIN = 60000;  // ms until the same is read out once more
const list = document.getElementById("alerts");
const announcer = document.getElementById("announcer");
const read = new Map();  // what was read out, and when
let last = new Set();  // of it what held at the time of the last reading
let waiting = "";
let since = 0;

function text(alert, picture) {
  const texts = words().alerts;
  if (alert === "silent" && !picture.heard) alert = "unheard";
  const end = picture?.route?.battery_ends_after_km;
  if (alert === "destination_unreachable" && known(end)) alert = "destination_unreachable_after";
  // "no GPS" is a reason; what is lost is the GPS.
  const lost = (picture?.lost ?? []).map((name) => word("reasons", name).replace(/^(no|keine?) /, ""));
  const bad = (picture?.distrusted ?? []).map((name) => word("sensors", name));
  return said(texts[alert] ?? alert, {
    channel: picture?.channel ?? "",
    file: picture?.file ?? "",
    end: distance(end),
    coldest: `${number(picture?.cells?.coldest_degc)}\u00a0°C`,
    hottest: `${number(picture?.cells?.hottest_degc)}\u00a0°C`,
    soc: percent(picture?.battery.soc_percent),
    which: [...lost, ...bad].join(", ") || DASH,
  });
}

export function drawAlerts(picture, problem) {
  const alerts = problem ? [problem] : picture.alerts;
  const lines = alerts.map((alert) => [alert, text(alert, picture)]);
  const drawn = JSON.stringify(lines);
  if (list.dataset.drawn === drawn) return;
  list.dataset.drawn = drawn;
  list.replaceChildren(
    ...lines.map(([alert, line]) => {
      const item = document.createElement("li");
      item.className = NOTES.includes(alert) ? "note" : WARNINGS.includes(alert) ? "warning" : "critical";
      item.dataset.alert = alert;
      item.textContent = line;
      return item;
    }),
  );
  // How many come after each: a small screen shows only the first ones.
  [...list.children].slice(0, -1).forEach((item, i) => { item.dataset.more = `(+${lines.length - 1 - i})`; });
}

// Reads out what has begun to hold: state, activity, alerts. Not what only moves, such as a number in an alert.
export function announce(picture, problem) {
  const state = picture?.state ?? "none";
  const holds = problem
    ? [`alert ${problem}`]
    : [`state ${state}`, ...(picture.activity ? [`activity ${picture.activity}`] : []),
       ...picture.alerts.map((alert) => `alert ${alert}`)];
  const now = performance.now();
  if (holds.join() !== waiting) {
    waiting = holds.join();
    since = now;
  }
  if (now - since < SETTLED) return;
  const fresh = holds.filter((one) => !last.has(one) && (!one.startsWith("alert") || now - (read.get(one) ?? -AGAIN) >= AGAIN));
  last = new Set(holds);
  if (!fresh.length) return;
  fresh.forEach((one) => read.set(one, now));
  announcer.textContent = fresh.map((one) => spoken(one, picture)).join(" ");
}

function spoken(one, picture) {
  const [kind, name] = one.split(" ");
  if (kind === "alert") return text(name, picture);
  if (kind === "activity") return `${word("activities", name)}.`;
  return `${words().range} ${word("states", name)}.`;
}
