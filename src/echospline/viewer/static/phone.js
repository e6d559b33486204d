// A phone as the probe: while its button is held, how far it has turned is sent to the page whose key is in the address.

const WORDS = {
  en: {
    title: "Hold the probe", how: "Hold the phone upright, as you hold a probe: its screen along the picture. While you hold the button, the slice turns with it.",
    take: "Hold and turn", on: "The slice follows.", off: "Connected.", lost: "The connection is lost; trying again.", gone: "The page of this phone is gone: scan its code again.",
    none: "This phone says nothing of its orientation. Phones give it to pages over https alone, and some ask first.",
  },
  de: {
    title: "Den Schallkopf halten", how: "Das Telefon aufrecht halten wie einen Schallkopf, den Bildschirm in der Bildebene. Solange der Knopf gehalten wird, dreht sich der Schnitt mit.",
    take: "Halten und drehen", on: "Der Schnitt folgt.", off: "Verbunden.", lost: "Die Verbindung ist unterbrochen; neuer Versuch.", gone: "Die Seite dieses Telefons ist fort: ihren Code neu einlesen.",
    none: "Dieses Telefon sagt seine Lage nicht. Telefone geben sie nur an Seiten über https, und manche fragen zuvor.",
  },
};
const say = WORDS[document.documentElement.lang === "de" ? "de" : "en"];
const query = new URLSearchParams(location.search), hash = new URLSearchParams(location.hash.slice(1));
const FASTEST = 1000 / 60; // ms between two messages
const take = /** @type {HTMLButtonElement} */ (document.getElementById("take"));
const put = (/** @type {string} */ id, /** @type {string} */ text) => {
  const place = document.getElementById(id);
  if (place && place.textContent !== text) place.textContent = text;
};

/** @type {WebSocket | null} */
let line = null;
/** @type {number[] | null} how the phone is held now: a rotation, row by row */
let held = null;
/** @type {number[] | null} how it was held when the button was pressed */
let first = null;
let sent = 0, gone = false;

put("title", say.title);
put("how", say.how);
take.textContent = say.take;
connect();
take.addEventListener("pointerdown", async (event) => {
  take.setPointerCapture(event.pointerId);
  const asks = /** @type {{ requestPermission?: () => Promise<string> } | undefined} */ (/** @type {unknown} */ (globalThis.DeviceOrientationEvent));
  if (asks?.requestPermission && (await asks.requestPermission().catch(() => "denied")) !== "granted") return put("state", say.none);
  first = held;
  take.setAttribute("aria-pressed", "true");
  put("state", held ? say.on : say.none);
});
for (const kind of ["pointerup", "pointercancel"]) take.addEventListener(kind, () => {
  first = null;
  take.setAttribute("aria-pressed", "false");
  if (held) put("state", say.off);
});
addEventListener("deviceorientation", ({ alpha, beta, gamma }) => {
  if (alpha === null || beta === null || gamma === null) return;
  held = rotation(alpha, beta, gamma);
  if (take.getAttribute("aria-pressed") !== "true") return;
  first ??= held;
  const now = performance.now();
  if (line?.readyState !== WebSocket.OPEN || now - sent < FASTEST) return;
  sent = now;
  line.send(JSON.stringify({ turn: turned(first, held) }));
  put("state", say.on);
});

function connect() {
  if (gone) return;
  const token = hash.get("token"), where = new URL("phone", location.href);
  where.protocol = where.protocol === "https:" ? "wss:" : "ws:";
  where.search = `?room=${encodeURIComponent(query.get("room") ?? "")}`;
  where.hash = "";
  line = new WebSocket(where, ["echospline.1", ...(token ? [`token.${token}`] : [])]);
  line.addEventListener("open", () => put("state", say.off));
  line.addEventListener("close", ({ code }) => {
    gone = code === 4404;
    put("state", gone ? say.gone : say.lost);
    setTimeout(connect, 1000);
  });
}

/**
 * The rotation of a phone's axes (x to its right, y to its top, z out of the screen) to the earth's, by the definition of deviceorientation.
 * @param {number} alpha @param {number} beta @param {number} gamma degrees
 */
export function rotation(alpha, beta, gamma) {
  const [a, b, g] = [alpha, beta, gamma].map((v) => (v * Math.PI) / 180);
  const [ca, sa, cb, sb, cg, sg] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b), Math.cos(g), Math.sin(g)];
  return [ca * cg - sa * sb * sg, -sa * cb, ca * sg + sa * sb * cg, sa * cg + ca * sb * sg, ca * cb, sa * sg - ca * sb * cg, -cb * sg, sb, cb * cg];
}

/**
 * Yaw, pitch and roll (degrees) of a plane that has turned as the phone has: the plane's lateral axis is the phone's x, its depth the phone's -y.
 * A turn of the plane by yaw about depth, then pitch about the lateral axis, then roll in the plane, each about the axes turned so far.
 * @param {number[]} from @param {number[]} to
 */
export function turned(from, to) {
  // From the phone's axes now to those at first: R = from^T to, in axes lateral, depth, across (x, -y, -z).
  const at = (/** @type {number} */ i, /** @type {number} */ j) => {
    let sum = 0;
    for (let k = 0; k < 3; ++k) sum += from[3 * k + i] * to[3 * k + j];
    return sum * (i ? -1 : 1) * (j ? -1 : 1);
  };
  return [Math.atan2(at(0, 2), at(2, 2)), Math.asin(Math.max(-1, Math.min(1, -at(1, 2)))), Math.atan2(at(1, 0), at(1, 1))].map((v) => Math.max(-360, Math.min(360, (v * 180) / Math.PI)));
}
