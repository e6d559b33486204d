// What comes from outside, checked: values of the wanted kind and size, or one sentence for a person.

/** Bytes that are no scene; the message is one sentence for a person. */
export class PackError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "PackError";
  }
}

/** @param {unknown} value @param {string} what @returns {Record<string, any>} */
export function asRecord(value, what) {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw new PackError(`Expected a table for ${what}; got ${shown(value)}.`);
  return value;
}

/** @param {unknown} value @param {string} what @param {number} least @param {number} most @returns {any[]} */
export function asList(value, what, least, most) {
  if (!Array.isArray(value) || value.length < least || value.length > most) {
    throw new PackError(`Expected a list of ${least === most ? least : `${least} to ${most}`} for ${what}; got ${Array.isArray(value) ? `${value.length} entries` : shown(value)}.`);
  }
  return value;
}

/** @param {unknown} value @param {string} what @param {number} low @param {number} high @returns {number} */
export function asNumber(value, what, low = -1e9, high = 1e9) {
  if (typeof value !== "number" || !Number.isFinite(value) || value < low || value > high) throw new PackError(`Expected a number from ${low} to ${high} for ${what}; got ${shown(value)}.`);
  return value;
}

/** @param {unknown} value @param {string} what @param {number} low @param {number} high @returns {number} */
export function asWhole(value, what, low, high) {
  const n = asNumber(value, what, low, high);
  if (!Number.isInteger(n)) throw new PackError(`Expected a whole number for ${what}; got ${n}.`);
  return n;
}

/** @param {unknown} value @param {string} what @param {number} count @returns {number[]} */
export function asNumbers(value, what, count) {
  return asList(value, what, count, count).map((n) => asNumber(n, what));
}

/** @param {unknown} value @param {string} what @param {number} most @returns {string} */
export function asText(value, what, most) {
  if (typeof value !== "string" || value.length > most) throw new PackError(`Expected at most ${most} characters for ${what}; got ${shown(value)}.`);
  return value;
}

/** A value in a message: short, whatever it is. @param {unknown} value */
export function shown(value) {
  const said = JSON.stringify(value) ?? String(value);
  return said.length > 40 ? `${said.slice(0, 40)}...` : said;
}
