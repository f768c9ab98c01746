// Texts in the rider's language.
import de from "./de.js";
import en from "./en.js";
import { settings } from "./settings.js";

const LANGUAGES = { en, de };

export const words = () => LANGUAGES[settings.language];

// A text with its {places} filled in.
export const said = (text, values) => text.replace(/\{(\w+)\}/g, (_, name) => values[name]);

// The word for a name; a name that a newer estimator sends and this page does not know, as it is.
export const word = (group, name) => words()[group][name] ?? name.replaceAll("_", " ");
