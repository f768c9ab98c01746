// The range as a band from P10 to P90 on a scale of the day's distance: what was ridden on the left, here 0, and where
// it ends, with the destination.
import { distance, distanceOnly, known, number, perUnit, scaleEnd } from "./numbers.js";
import { said, words } from "./words.js";

const PARTS = { 1: 4, 1.5: 3, 2: 4, 3: 3, 4: 4, 5: 5, 6: 3, 8: 4, 10: 4 };  // of a scale, by its first digits
const ROOM = 12;  // %: that a number under the scale takes
const band = document.getElementById("band");
const part = (name) => band.querySelector(`.${name}`);

function place(element, left, right) {
  element.hidden = left === null;
  if (left === null) return;
  element.style.left = `${left}%`;
  if (right !== undefined) element.style.width = `${Math.max(right - left, 0.5)}%`;
}

function label(range, route, ridden) {
  const text = words();
  const texts = [
    known(range.km)
      ? said(text.band, { middle: distance(range.km), p10: distance(range.p10_km), p90: distance(range.p90_km) })
      : text.band_unknown,
  ];
  if (known(route?.left_km)) texts.push(said(text.band_goal, { left: distance(route.left_km) }));
  if (known(ridden)) texts.push(said(text.band_ridden, { ridden: distance(ridden) }));
  return texts.join(" ");
}

function tick(text, left) {
  const mark = document.createElement("span");
  mark.textContent = text;
  mark.style.left = `${left}%`;
  return mark;
}

// The numbers under the scale, as many as there is room for: with 0 at `here` [%], and what was ridden left of it.
function drawTicks(end, here, ridden) {
  const marks = here >= ROOM ? [tick(`−${distanceOnly(ridden)}`, 0)] : [];
  marks[0]?.classList.add("behind-us");
  const parts = end ? PARTS[String(end / 10 ** Math.floor(Math.log10(end)))] ?? 4 : -1;
  const every = Math.max(Math.ceil((parts * ROOM) / (100 - here)), 1);
  for (let i = 0; i <= parts; i += every) {
    const value = (end * i) / parts;
    marks.push(tick(number(value, Number.isInteger(value) ? 0 : end < 2 ? 2 : 1), here + ((100 - here) * i) / parts));
  }
  part("ticks").replaceChildren(...marks);
}

export function drawBand(range, route, ridden) {
  const goal = route?.left_km ?? null;
  const furthest = Math.max(range.p90_km ?? range.km ?? 0, goal ?? 0) / perUnit();
  const end = furthest > 0 || known(range.km) ? scaleEnd(furthest) : 0;
  const behind = end && known(ridden) ? ridden / perUnit() : 0;
  const here = behind ? (100 * behind) / (behind + end) : 0;
  const at = (km) => (known(km) && end ? Math.min(here + ((100 - here) * km) / perUnit() / end, 100) : null);
  // Where P90 is beyond what the frames can say, the band goes on to the end of the scale.
  place(part("between"), at(range.p10_km), known(range.p90_km) ? at(range.p90_km) : 100);
  place(part("middle"), at(range.km));
  place(part("goal"), at(goal));
  place(part("behind"), here ? 0 : null, here);
  part("goal").classList.toggle("far", goal !== null && at(goal) > 60);
  drawTicks(end, here, ridden);
  band.setAttribute("aria-label", label(range, route, ridden));
}
