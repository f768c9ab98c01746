// Numbers as they are written: in the rider's unit and language, a dash for what is not known.
import { settings } from "./settings.js";

export const DASH = "–";
const GAP = "\u00a0";  // no line ends between a number and its unit
const KM_PER_MI = 1.609344;

export const perUnit = () => (settings.unit === "mi" ? KM_PER_MI : 1);
export const known = (value) => value !== null && value !== undefined;

export function number(value, digits = 0, signed = false) {
  if (!known(value)) return DASH;
  const form = { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false };
  if (signed) form.signDisplay = "exceptZero";
  return new Intl.NumberFormat(settings.language, form).format(value).replace("-", "−");
}

// Without its unit: whole kilometres or miles from ten on, as the interval is wider than that.
export function distanceOnly(km) {
  if (!known(km)) return DASH;
  const value = km / perUnit();
  return number(value, value < 9.95 ? 1 : 0);
}

export const distance = (km) => (known(km) ? `${distanceOnly(km)}${GAP}${settings.unit}` : DASH);
export const change = (km) => `${number(km / perUnit(), 1, true)}${GAP}${settings.unit}`;
export const consumption = (whPerKm) => number(known(whPerKm) ? whPerKm * perUnit() : null);
export const percent = (value, digits = 0) => (known(value) ? `${number(value, digits)}${GAP}%` : DASH);

// Speed and the time of day as short as they go; miles per hour have a name of their own.
export const speed = (kmh) => (known(kmh) ? `${number(kmh / perUnit())}${GAP}${settings.unit === "mi" ? "mph" : "km/h"}` : "");

// Nothing on a board that was not told the time yet.
export function clock() {
  const now = new Date();
  if (now.getFullYear() < 2001) return "";
  return now.toLocaleTimeString(settings.language, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
}

// Watts below a kilowatt, then kilowatts.
export function power(watts) {
  if (!known(watts)) return DASH;
  return watts < 1000 ? `${number(watts)}${GAP}W` : `${number(watts / 1000, 1)}${GAP}kW`;
}

export function energy(wh) {
  if (!known(wh)) return DASH;
  return wh < 10000 ? `${number(wh)}${GAP}Wh` : `${number(wh / 1000, 1)}${GAP}kWh`;
}

export function duration(minutes) {
  if (!known(minutes)) return DASH;
  const whole = Math.round(minutes);
  return whole < 60 ? `${whole}${GAP}min` : `${Math.floor(whole / 60)}${GAP}h${GAP}${String(whole % 60).padStart(2, "0")}${GAP}min`;
}

// The next round number from `value` on.
export function scaleEnd(value) {
  if (!(value > 1)) return 1;
  const size = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => step * size).find((end) => end >= value);
}
