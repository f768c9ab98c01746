// What the rider chose: kept in localStorage, and for this page alone in the address: ?theme=night&unit=mi&language=de
const CHOICES = { theme: ["auto", "day", "night"], unit: ["km", "mi"], language: ["en", "de"] };
const FIRST = { theme: "auto", unit: "km", language: navigator.language.startsWith("de") ? "de" : "en" };
const asked = new URLSearchParams(location.search);

export const settings = {};
for (const [name, choices] of Object.entries(CHOICES)) {
  settings[name] = [asked.get(name), kept(name), FIRST[name]].find((choice) => choices.includes(choice));
}

function kept(name) {
  try { return localStorage.getItem(name); } catch { return null; }  // storage may be forbidden
}

// The next choice of a switch.
export function advance(name) {
  const choices = CHOICES[name];
  settings[name] = choices[(choices.indexOf(settings[name]) + 1) % choices.length];
  try { localStorage.setItem(name, settings[name]); } catch { /* then it holds until the page is closed */ }
}
