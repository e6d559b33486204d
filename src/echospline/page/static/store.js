// What the browser keeps: attempts in IndexedDB, choices in localStorage. Pages from files share both, so every key is named.

import { readSession } from "./training.js";

/** @import { Session } from "./training.js" */

const DATABASE = "echospline-page", STORE = "sessions", CHOICES = "echospline-page-choices";

/** Attempts of this device. Where the browser refuses, they last as long as the page, and `refused` says why. */
export class Store {
  constructor() {
    /** @type {IDBDatabase | null} */
    this.database = null;
    /** @type {Session[]} */
    this.sessions = [];
    /** Key of each in the database, and its number at a server: 0 not handed in, -1 refused. @type {Map<Session, { key: IDBValidKey | null, number: number }>} */
    this.kept = new Map();
    this.refused = "";
  }

  async open() {
    try {
      const request = indexedDB.open(DATABASE, 1);
      request.onupgradeneeded = () => request.result.createObjectStore(STORE, { autoIncrement: true });
      this.database = await finished(request);
      const store = this.database.transaction(STORE).objectStore(STORE), [values, keys] = await Promise.all([finished(store.getAll()), finished(store.getAllKeys())]);
      this.sessions = values.flatMap((value, k) => {
        try {
          const session = readSession(value, "a kept attempt");
          this.kept.set(session, { key: keys[k], number: Number(value.handed ?? 0) });
          return [session];
        } catch {
          return []; // of another page or version: it stays in the database and is not shown
        }
      });
    } catch (error) {
      this.refused = error instanceof Error ? error.message : String(error);
    }
  }

  /** @param {Session[]} sessions */
  async add(sessions) {
    this.sessions = [...this.sessions, ...sessions];
    if (!this.database) return;
    try {
      const store = this.database.transaction(STORE, "readwrite").objectStore(STORE);
      for (const session of sessions) this.kept.set(session, { key: await finished(store.add(session)), number: 0 });
    } catch (error) {
      this.refused = error instanceof Error ? error.message : String(error);
    }
  }

  /** Attempts of this page that no server has. */
  waiting() {
    return this.sessions.filter((session) => !this.kept.get(session)?.number);
  }

  /** Keep the number that a server gave. @param {Session} session @param {number} number */
  async handed(session, number) {
    const key = this.kept.get(session)?.key ?? null;
    this.kept.set(session, { key, number });
    if (this.database && key !== null) await finished(this.database.transaction(STORE, "readwrite").objectStore(STORE).put({ ...session, handed: number }, key));
  }

  async erase() {
    this.sessions = [];
    this.kept.clear();
    if (this.database) await finished(this.database.transaction(STORE, "readwrite").objectStore(STORE).clear());
  }
}

/** @template T @param {IDBRequest<T>} request @returns {Promise<T>} */
function finished(request) {
  return new Promise((done, failed) => {
    request.onsuccess = () => done(request.result);
    request.onerror = () => failed(request.error ?? new Error("refused"));
  });
}

/** Choices of the last visit: language, theme, trainee. @returns {Record<string, string>} */
export function keptChoices() {
  try {
    const value = JSON.parse(localStorage.getItem(CHOICES) ?? "{}");
    return Object.fromEntries(Object.entries(value).filter(([, kept]) => typeof kept === "string" && kept.length <= 80));
  } catch {
    return {};
  }
}

/** @param {Record<string, string>} choices */
export function keepChoices(choices) {
  try {
    localStorage.setItem(CHOICES, JSON.stringify(choices));
  } catch {
    // a browser that keeps nothing: the page works as on its first visit
  }
}
