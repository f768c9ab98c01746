// One picture onto the page. Every number that it does not have is a dash; nothing of the last one stays.
import { announce, drawAlerts } from "./alerts.js";
import { drawBand } from "./band.js";
import { DASH, change, clock, consumption, distance, distanceOnly, duration, energy, known, number, perUnit, percent, power, speed } from "./numbers.js";
import { settings } from "./settings.js";
import { said, word, words } from "./words.js";

const NOTHING = {
  channel: "", state: null, activity: null, range: { km: null, p10_km: null, p90_km: null }, range_10min_km: [],
  battery: { soc_percent: null, soc_sigma_percent: null, energy_left_wh: null }, cells: null, speed_km_h: null, ridden_today_km: null,
  consumption: { recent_wh_per_km: null, expected_wh_per_km: null }, charge: null, route: null, rated_km: null,
  causes: [], reasons: [], distrusted: [], stale: [], alerts: [], counts: null,
};
const KEEPING = ["log_failed", "save_failed"];
const SIGNS = { valid: "✓", degraded: "!", invalid: "✕", starting: "…", none: "?", waiting: "…" };
const SAME = 0.03;  // a consumption so near to the expected is as expected
const LEAST_CHANGE = 0.2;  // of the range: a trend that changes less does not fill its height
const byId = (id) => document.getElementById(id);

function put(id, text) {
  const element = byId(id);
  if (element.textContent !== text) element.textContent = text;
}

function hide(id, hidden) {
  byId(id).hidden = hidden;
}

function bullets(id, title, lines) {
  const text = lines.length ? `${title} ${lines.join(", ")}` : "";
  const list = byId(id);
  if (list.dataset.drawn === text) return;
  list.dataset.drawn = text;
  list.replaceChildren(
    ...(lines.length ? [title, ...lines] : []).flatMap((line, i) => {
      const item = document.createElement("li");
      item.textContent = title && i > 0 && i < lines.length ? `${line},` : line;
      return [item, " "];  // where they share a line, a space is between them
    }),
  );
}

function drawRange({ range, route, ridden_today_km: ridden }) {
  put("range-value", distanceOnly(range.km));
  const places = { p10: distanceOnly(range.p10_km), p90: distanceOnly(range.p90_km), unit: settings.unit };
  put("interval", known(range.km) ? said(words().interval, places) : DASH);
  put("share", known(range.km) ? words().share : "");
  put("ridden", known(ridden) ? said(words().ridden, { ridden: distance(ridden) }) : "");
  drawBand(range, route, ridden);
}

// The range of the last ten minutes as a line, the present at its right end; nothing before there are two points.
function drawTrend(trend) {
  const points = trend.map((km, i) => [i, km]).filter(([, km]) => known(km));
  hide("trend", points.length < 2);
  if (points.length < 2) return;
  const values = points.map(([, km]) => km);
  const middle = (Math.max(...values) + Math.min(...values)) / 2;
  const half = Math.max(Math.max(...values) - middle, (LEAST_CHANGE * middle) / 2, 1e-3);
  const at = ([i, km]) => `${((100 * i) / (trend.length - 1)).toFixed(1)} ${(50 - (50 * (km - middle)) / half).toFixed(1)}`;
  const joined = (i) => i > 0 && points[i][0] - points[i - 1][0] === 1;
  const path = points.map((point, i) => `${joined(i) ? "L" : "M"}${at(point)}`).join("");
  const svg = byId("trend").firstElementChild;
  svg.firstElementChild.setAttribute("d", path);
  svg.setAttribute("aria-label", said(words().trend, { first: distance(values[0]), last: distance(values.at(-1)) }));
}

function drawBattery({ battery, cells }) {
  const { soc_percent: soc, soc_sigma_percent: sigma } = battery;
  put("soc-value", number(soc));
  put("soc-sigma", known(sigma) ? said(words().sigma, { sigma: number(sigma, 1) }) : "");
  put("energy", known(battery.energy_left_wh) ? said(words().left, { energy: energy(battery.energy_left_wh) }) : DASH);
  hide("cells", !cells);
  const [coldest, hottest] = [cells?.coldest_degc, cells?.hottest_degc].map((value) => number(value));
  put("cells", coldest === hottest ? said(words().cells, { hottest }) : said(words().cells_between, { coldest, hottest }));
  const [full, doubt] = byId("soc-bar").children;
  full.hidden = !known(soc);
  doubt.hidden = !known(soc) || !known(sigma);
  full.style.width = `${Math.min(Math.max(soc ?? 0, 0), 100)}%`;
  const low = Math.max((soc ?? 0) - (sigma ?? 0), 0);
  doubt.style.left = `${low}%`;
  doubt.style.width = `${Math.min((soc ?? 0) + (sigma ?? 0), 100) - low}%`;
}

function drawConsumption({ consumption: used }) {
  const { recent_wh_per_km: recent, expected_wh_per_km: expected } = used;
  put("recent", consumption(recent));
  put("expected", consumption(expected));
  const most = Math.max(recent ?? 0, expected ?? 0);
  for (const [id, value] of [["recent-bar", recent], ["expected-bar", expected]]) {
    byId(id).hidden = !(value > 0);
    byId(id).style.width = `${value > 0 ? (100 * value) / most : 0}%`;
  }
  // Of the numbers as they are shown, which a reader compares; nothing where one is missing.
  const [shown, against] = [recent, expected].map((value) => Math.round((value ?? 0) * perUnit()));
  if (!known(recent) || !known(expected) || against <= 0) return put("compared", "");
  const share = shown / against - 1;
  const key = Math.abs(share) < SAME ? "as_expected" : share > 0 ? "more" : "less";
  return put("compared", said(words()[key], { share: percent(Math.abs(share) * 100) }));
}

function drawCharge({ charge }) {
  hide("charge", !charge);
  put("charge-power", power(charge?.power_w));
  put("charge-full", said(words().full_in, { time: duration(charge?.time_to_full_min) }));
  put("charge-range", said(words().full_range, { range: distance(charge?.range_full_km) }));
}

function drawRoute({ route }) {
  hide("route", !route);
  const on = Boolean(route?.on_route);
  put("route-left", on ? said(words().to_go, { left: distance(route.left_km) }) : words().off_route);
  const arrival = { soc: percent(route?.arrival_soc_percent), p10: percent(route?.arrival_soc_p10_percent) };
  const end = route?.battery_ends_after_km;
  put("route-arrival", !on ? "" : known(end) ? said(words().ends_after, { end: distance(end) }) : said(words().arrival, arrival));
}

function drawWhy({ causes, rated_km: rated }) {
  const lines = causes.map(({ cause, km }) => `${word("causes", cause)} ${change(km)}`);
  bullets("causes", "", lines.length ? lines : [known(rated) ? words().no_causes : DASH]);
  put("rated", known(rated) ? said(words().rated, { range: distance(rated) }) : DASH);
}

function drawState(picture, problem) {
  const waiting = picture.alerts.includes("waiting");
  const state = waiting ? "waiting" : picture.state ?? "none";
  byId("trust").dataset.state = state;
  put("trust-sign", SIGNS[state] ?? "");
  put("trust-word", word("states", state));
  put("source", picture.channel);
  put("activity", picture.activity ? word("activities", picture.activity) : DASH);
  // What fails of keeping the ride makes no range less certain.
  const [kept, why] = [true, false].map((is) => picture.reasons.filter((name) => KEEPING.includes(name) === is));
  const notes = kept.map((name) => word("reasons", name)).map((text) => `${text[0].toUpperCase()}${text.slice(1)}.`);
  put("meaning", [word("meanings", state), ...notes].join(" "));
  const because = said(state === "valid" ? words().wider : words().because, { state: word("states", state) });
  bullets("reasons", because, why.filter((name) => !waiting || !name.startsWith("no_")).map((name) => word("reasons", name)));
  bullets("distrusted", words().left_out, picture.distrusted.map((name) => word("sensors", name)));
  bullets("missing", words().stale, picture.stale.map((name) => word("messages", name)));
  put("frames", picture.counts ? said(words().frames, picture.counts) : DASH);
  document.body.classList.toggle("gone", Boolean(problem));
}

function drawWords() {
  const text = words();
  document.documentElement.lang = settings.language;
  document.querySelectorAll("[data-word]").forEach((element) => { element.textContent = text[element.dataset.word]; });
  document.querySelectorAll("[data-unit]").forEach((element) => { element.textContent = settings.unit; });
  byId("alerts").setAttribute("aria-label", text.alerts_label);
  for (const name of ["theme", "unit", "language"]) put(name, text.settings[name][settings[name]]);
}

let drawnFor = "";

// picture: the newest, or null with the problem: "gone", "hung".
export function draw(picture, problem) {
  const wanted = JSON.stringify(settings);
  if (drawnFor !== wanted) drawWords();
  drawnFor = wanted;
  const shown = problem || !picture ? NOTHING : picture;
  put("speed", speed(shown.speed_km_h));
  put("clock", picture || problem ? clock() : "");
  drawRange(shown);
  drawTrend(shown.range_10min_km);
  drawBattery(shown);
  drawConsumption(shown);
  drawCharge(shown);
  drawRoute(shown);
  drawWhy(shown);
  drawState(shown, problem);
  drawAlerts(shown, problem);
  document.title = `${distance(shown.range.km)} · gz-onboard`;
  announce(shown, problem);
}
