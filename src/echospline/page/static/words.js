// Every word of the page, by one table of two languages. Places in braces are filled in.

/** @type {Record<string, [string, string]>} key: English, German */
const TABLE = {
  // picture
  "stage": ["Ultrasound picture with the needle. Arrow keys push, pull and turn it; the question mark shows all keys.", "Ultraschallbild mit der Nadel. Pfeiltasten schieben, ziehen und drehen sie; das Fragezeichen zeigt alle Tasten."],
  "target": ["target", "Ziel"], "vessel": ["vessel", "Gefäß"], "expert": ["expert", "Experte"], "frozen": ["Frozen", "Eingefroren"],
  "depth-short": ["in", "ein"], "to-target": ["to target", "zum Ziel"], "off-plane": ["beside the picture", "neben dem Bild"], "gain-short": ["G", "G"], "range-short": ["DR", "DR"], "time-gain-short": ["TGC", "TGC"],
  "spoken": ["Needle {depth} mm deep, angle {angle} degrees.", "Nadel {depth} mm tief, Winkel {angle} Grad."],
  "spoken-target": ["Tip {distance} mm from the target.", "Spitze {distance} mm vom Ziel."],
  // hint
  "hint-1": ["Press near the skin: the needle enters there.", "Nahe der Haut drücken: dort sticht die Nadel ein."],
  "hint-2": ["Press in the picture to aim, then drag to push.", "Im Bild drücken, um zu zielen; dann ziehen, um zu schieben."],
  "hint-3": ["Start: bring the tip into the ring. The tissue moves with it.", "Start: die Spitze in den Ring bringen. Das Gewebe geht mit."],
  "keys-hint": ["Keys: arrows steer, ? shows all", "Tasten: Pfeile steuern, ? zeigt alle"],
  // tools
  "freeze": ["Freeze", "Einfrieren"], "freeze-title": ["Let time stand still (C)", "Die Zeit anhalten (C)"],
  "flip": ["Flip", "Spiegeln"], "flip-title": ["Exchange left and right; the dot marks the probe's marked side (F)", "Links und rechts tauschen; der Punkt zeigt die markierte Seite der Sonde (F)"],
  "invert": ["Invert", "Umkehren"], "invert-title": ["Black for white (I)", "Schwarz für Weiß (I)"],
  "caliper": ["Measure", "Messen"], "caliper-title": ["Measure a distance in mm: drag, or arrows and Enter (M)", "Einen Abstand in mm messen: ziehen, oder Pfeile und Eingabe (M)"],
  "note": ["Label", "Notiz"], "note-title": ["Write on the picture (T)", "Auf das Bild schreiben (T)"],
  "clear": ["Clear", "Löschen"], "clear-title": ["Remove measurements and labels (Delete)", "Messungen und Notizen entfernen (Entf)"],
  "picture": ["Picture", "Bild"], "picture-title": ["Save the picture as PNG (P)", "Das Bild als PNG speichern (P)"],
  "clip": ["Clip", "Film"], "clip-title": ["Save the last seconds as a video (V)", "Die letzten Sekunden als Film speichern (V)"],
  "reset": ["Reset", "Zurück"], "reset-title": ["Needle out, tissue at rest; ends and keeps a running attempt (Space)", "Nadel heraus, Gewebe in Ruhe; beendet und bewahrt einen laufenden Versuch (Leertaste)"],
  "tools": ["Tools", "Werkzeuge"], "help": ["Help", "Hilfe"], "theme": ["Light or dark", "Hell oder dunkel"], "language": ["Deutsch", "English"],
  "push": ["Push", "Schieben"], "pull": ["Pull", "Ziehen"], "turn-left": ["Turn one way", "In die eine Richtung drehen"], "turn-right": ["Turn the other way", "In die andere Richtung drehen"],
  "pad": ["Move the needle", "Die Nadel bewegen"],
  // panels
  "training": ["Training", "Training"], "exercises": ["Exercises", "Übungen"], "trainee": ["Trainee", "Name"], "optional": ["optional", "freiwillig"],
  "start": ["Start", "Start"], "finish": ["Finish", "Fertig"], "start-title": ["Start or finish (E)", "Beginnen oder beenden (E)"],
  "sessions": ["Attempts", "Versuche"], "sessions-title": ["Attempts kept on this device (L)", "Versuche auf diesem Gerät (L)"],
  "examination": ["Examination", "Prüfung"], "examination-title": ["No guide, no numbers, no rings once the needle is in; every attempt counts", "Keine Linie, keine Zahlen, keine Ringe, sobald die Nadel drin ist; jeder Versuch zählt"],
  "entry-rule": ["Entry", "Einstich"], "entry-free": ["free", "frei"], "entry-fixed": ["fixed", "fest"], "entry-drawn": ["drawn by lot", "ausgelost"],
  "model": ["Tissue model", "Gewebemodell"], "image": ["Picture", "Bild"], "needle": ["Needle", "Nadel"], "helps": ["Help", "Hilfen"],
  "seen": ["Depth", "Tiefe"], "gain": ["Gain", "Verstärkung"], "range": ["Dynamic range", "Dynamik"], "time-gain": ["Time gain", "Tiefenausgleich"], "time-gain-at": ["Time gain at {mm} mm", "Tiefenausgleich bei {mm} mm"],
  "flat": ["Level", "Zurücksetzen"], "flat-title": ["Gain, time gain and dynamic range back to the start", "Verstärkung, Tiefenausgleich und Dynamik wie zu Beginn"],
  "entry": ["Entry", "Einstich"], "angle": ["Angle", "Winkel"], "depth": ["Depth", "Tiefe"],
  "guide": ["Guide line", "Führungslinie"], "rings": ["Rings", "Ringe"], "readouts": ["Numbers", "Zahlen"],
  "probe": ["Probe", "Sonde"], "probe-x": ["Left, right", "Links, rechts"], "probe-z": ["Front, back", "Vor, zurück"], "probe-turn": ["Turn", "Drehen"], "probe-tilt": ["Tilt", "Kippen"], "probe-rock": ["Rock", "Wippen"],
  "view-along": ["Along", "Längs"], "view-along-title": ["The picture holds the whole needle (X)", "Das Bild enthält die ganze Nadel (X)"], "view-across": ["Across", "Quer"], "view-across-title": ["The picture cuts the needle at its tip (Z)", "Das Bild schneidet die Nadel an der Spitze (Z)"],
  "entry-z": ["Entry, back", "Einstich, tief"], "heading": ["Heading", "Richtung"], "body": ["Drawing", "Skizze"], "motion": ["Motion", "Bewegung"],
  "key-probe": ["slide the probe; with Shift turn and tilt", "Sonde schieben; mit Umschalt drehen und kippen"], "key-rock": ["rock the probe", "Sonde wippen"], "key-views": ["probe along, across the needle", "Sonde längs, quer zur Nadel"], "key-heading": ["needle's heading, drawing", "Richtung der Nadel, Skizze"],
  "hint-3-space": ["The small drawing moves the probe: drag it.", "Die kleine Skizze bewegt die Sonde: dort ziehen."],
  // messages
  "model-kept": ["The model stays as it is while an attempt is recorded.", "Während ein Versuch läuft, bleibt das Modell."],
  "no-attempts": ["This exercise has {count} attempts, and all of them are made.", "Diese Übung hat {count} Versuche, und alle sind gemacht."],
  "recording": ["Attempt {attempt}: {title}", "Versuch {attempt}: {title}"], "replaying": ["Replay: {title}", "Wiedergabe: {title}"],
  "stored": ["Attempt kept.", "Versuch gespeichert."], "not-stored": ["This browser keeps nothing for pages like this ({reason}): attempts last until the page is closed. Export them.", "Dieser Browser bewahrt für solche Seiten nichts auf ({reason}): Versuche bleiben, bis die Seite geschlossen wird. Exportiere sie."],
  "stopped": ["The model stopped: {reason} Reset starts it again.", "Das Modell hielt an: {reason} Zurück startet es neu."],
  "clip-works": ["The last {seconds} seconds are drawn again and saved...", "Die letzten {seconds} Sekunden werden nochmals gezeichnet und gespeichert..."],
  "clip-none": ["Nothing has moved yet.", "Noch hat sich nichts bewegt."], "clip-refused": ["This browser records no video: {reason}", "Dieser Browser nimmt keinen Film auf: {reason}"],
  "saved": ["Saved {name}.", "{name} gespeichert."], "imported": ["Attempts read: {count}.", "Gelesene Versuche: {count}."], "other-scene": ["This attempt was made with another scene.", "Dieser Versuch entstand mit einer anderen Szene."],
  "no-model": ["This scene has no model {name}.", "Diese Szene hat kein Modell {name}."],
  // server
  "server-lost": ["The server is lost: this page goes on, and attempts are kept here.", "Der Server ist weg: Diese Seite läuft weiter, Versuche bleiben hier."], "tracker": ["Tracker: {text}", "Tracker: {text}"],
  "handed": ["Attempt {number} is kept and verified by the server.", "Versuch {number} ist vom Server gespeichert und bestätigt."], "handed-unchecked": ["Attempt {number} is kept by the server.", "Versuch {number} ist vom Server gespeichert."],
  "handed-differs": ["The server kept attempt {number} and computes it differently: {difference}", "Der Server hat Versuch {number} gespeichert und rechnet ihn anders: {difference}"], "refused": ["The server did not take this attempt: {reason}", "Der Server nahm diesen Versuch nicht an: {reason}"],
  "open": ["Open", "Öffnen"], "open-title": ["Open another picture", "Ein anderes Bild öffnen"], "open-text": ["An image, cine or DICOM file of yours; the server reads it for this page alone.", "Eine Bild-, Film- oder DICOM-Datei; der Server liest sie nur für diese Seite."],
  "open-none": ["Choose a file.", "Eine Datei wählen."], "open-works": ["The server reads the file...", "Der Server liest die Datei..."], "spacing": ["Pixel spacing, mm", "Pixelabstand, mm"],
  "dicom": ["DICOM", "DICOM"], "dicom-title": ["Save the last seconds as DICOM", "Die letzten Sekunden als DICOM speichern"], "fem": ["FEM", "FEM"], "fem-title": ["Compare with finite elements at this pose", "Mit finiten Elementen in dieser Lage vergleichen"],
  "fem-none": ["Push the needle first.", "Zuerst die Nadel schieben."], "fem-shown": ["Finite elements", "Finite Elemente"], "fem-works": ["The server computes finite elements...", "Der Server rechnet finite Elemente..."], "fem-differs": ["Shown: finite elements. {model} differs by {mean} mm on average, {most} mm at most.", "Gezeigt: finite Elemente. {model} weicht im Mittel {mean} mm ab, höchstens {most} mm."],
  "phone": ["Phone", "Telefon"], "phone-title": ["A phone as the probe", "Ein Telefon als Sonde"], "phone-text": ["Open this address on a phone in the same network and hold its button: the probe turns with it. Phones give their orientation to https alone.", "Diese Adresse auf einem Telefon im selben Netz öffnen und den Knopf halten: Die Sonde dreht sich mit. Telefone geben ihre Lage nur an https."],
  "phone-there": ["The phone is connected.", "Das Telefon ist verbunden."], "phone-gone": ["The phone is gone.", "Das Telefon ist weg."],
  // summary
  "passed": ["Passed", "Bestanden"], "failed": ["Not passed", "Nicht bestanden"], "again": ["Again", "Noch einmal"], "replay": ["Replay", "Wiedergabe"], "close": ["Close", "Schließen"], "export": ["Export", "Exportieren"], "import": ["Import", "Importieren"],
  "ended-reset": ["Ended by Reset.", "Durch Zurück beendet."], "ended-time": ["Time is up.", "Die Zeit ist um."],
  "why-out": ["the needle was not in the tissue at the end", "die Nadel war am Ende nicht im Gewebe"],
  "why-far": ["the tip ended {error} mm from the target's centre (its radius is {radius} mm)", "die Spitze endete {error} mm von der Mitte des Ziels (sein Radius ist {radius} mm)"],
  "why-hit": ["the tip ended {error} mm from the target's centre", "die Spitze endete {error} mm von der Mitte des Ziels"],
  "why-vessel": ["contacts with vessels: {count}", "Kontakte mit Gefäßen: {count}"],
  "why-turns": ["{count} redirections, {most} allowed", "{count} Richtungswechsel, {most} erlaubt"],
  "final_error": ["Tip to target", "Spitze zum Ziel"], "target_shift": ["Target moved by the tissue", "Ziel vom Gewebe bewegt"], "time": ["Time", "Zeit"], "picture_time": ["Tip in the picture", "Spitze im Bild"], "tissue_time": ["Time in tissue", "Zeit im Gewebe"], "path_length": ["Path length", "Weglänge"],
  "path_inefficiency": ["Path inefficiency", "Umweg"], "tissue_damage": ["Tissue damage (area swept)", "Gewebeschaden (überstrichene Fläche)"], "punctures": ["Punctures", "Einstiche"],
  "redirections": ["Redirections", "Richtungswechsel"], "vessel_contacts": ["Vessel contacts", "Gefäßberührungen"], "smoothness": ["Smoothness (less is smoother)", "Ruck (weniger ist ruhiger)"],
  "plot-distance": ["tip to target", "Spitze zum Ziel"], "plot-depth": ["depth", "Tiefe"], "plot-time": ["time, s", "Zeit, s"], "plot-radius": ["target radius", "Zielradius"], "plot-attempt": ["attempt", "Versuch"], "plot-expert": ["expert", "Experte"],
  "progress": ["Learning curve", "Lernkurve"], "progress-plot": ["Tip to target over attempts", "Spitze zum Ziel über die Versuche"], "summary-plot": ["Depth and distance to the target over time", "Tiefe und Abstand zum Ziel über die Zeit"],
  // attempts
  "no-sessions": ["No attempt has been made yet.", "Noch gibt es keinen Versuch."], "number": ["No.", "Nr."], "started": ["Started", "Begonnen"], "exercise": ["Exercise", "Übung"], "result": ["Result", "Ergebnis"],
  "as-expert": ["Beside me", "Neben mir"], "as-expert-title": ["Show this attempt beside every replay", "Diesen Versuch neben jeder Wiedergabe zeigen"], "everybody": ["everybody", "alle"], "erase": ["Erase all", "Alle löschen"], "erase-sure": ["Erase all attempts kept on this device?", "Alle Versuche auf diesem Gerät löschen?"],
  "attempts-shown": ["{passed} of {count} passed", "{passed} von {count} bestanden"],
  // the class
  "class": ["Class", "Klasse"], "class-open-title": ["Sessions and learning curves of the class", "Versuche und Lernkurven der Klasse"], "class-title": ["The class", "Die Klasse"], "nobody": ["no name", "ohne Name"],
  "own": ["Curve", "Kurve"], "own-open-title": ["My sessions on the server, my learning curve, and experts", "Meine Versuche auf dem Server, meine Lernkurve, und Vorbilder"], "own-title": ["My sessions on the server", "Meine Versuche auf dem Server"],
  "class-median": ["median of the class", "Median der Klasse"], "class-threshold": ["proficient", "sicher"], "cusum": ["LC-CUSUM", "LC-CUSUM"], "class-shown": ["Curve", "Kurve"], "class-plot": ["Curves over attempts", "Kurven über die Versuche"],
  "class-meaning": ["Every attempt that is verified counts, also one given up by Reset. Proficient is who reaches {threshold}: one who fails {rate} % of the attempts does so within {attempts} with a probability of at most {risk} %.", "Jeder geprüfte Versuch zählt, auch ein durch Zurück aufgegebener. Sicher ist, wer {threshold} erreicht: wer {rate} % der Versuche nicht besteht, erreicht das in {attempts} mit höchstens {risk} % Wahrscheinlichkeit."],
  "class-attempts": ["Attempts", "Versuche"], "class-attempt": ["Attempt", "Versuch"], "class-passed": ["Passed", "Bestanden"], "class-proficient": ["Proficient", "Sicher"], "class-not-yet": ["not yet", "noch nicht"], "class-since": ["since attempt {attempt}", "seit Versuch {attempt}"],
  "class-check": ["Run again", "Nachgerechnet"], "class-verified": ["same numbers", "gleiche Zahlen"], "class-differs": ["does not count", "zählt nicht"], "class-benchmark": ["Benchmark", "Vorbild"], "class-benchmark-title": ["Show this attempt's level to the class", "Diesen Versuch der Klasse als Vorbild zeigen"],
  "class-csv": ["Sessions as CSV", "Versuche als CSV"], "class-curves-csv": ["Curves as CSV", "Kurven als CSV"], "class-again": ["Read anew", "Neu lesen"],
  // replay
  "play": ["Play", "Abspielen"], "pause": ["Pause", "Anhalten"], "speed": ["Speed", "Tempo"], "scrub": ["Place in the replay", "Stelle der Wiedergabe"], "leave": ["End replay", "Beenden"],
  "event-entered": ["needle in", "Nadel ein"], "event-left": ["needle out", "Nadel aus"], "event-vessel": ["vessel touched", "Gefäß berührt"], "event-target": ["target reached", "Ziel erreicht"], "event-lost": ["tip lost from the picture", "Spitze aus dem Bild"], "event-redirection": ["redirection", "Richtungswechsel"],
  // help and notes
  "help-title": ["How to steer", "So steuerst du"],
  "help-text": ["Press near the skin to choose the entry, or inside the picture to aim. Drag to push and pull along the needle; with Shift or the right button, or with two fingers, turn it about its entry. The wheel pushes too. How fast you push matters, and under a needle at rest the tissue relaxes.", "Nahe der Haut drücken, um den Einstich zu wählen, oder im Bild, um zu zielen. Ziehen schiebt und zieht entlang der Nadel; mit Umschalt oder der rechten Taste oder zwei Fingern dreht sie um den Einstich. Auch das Rad schiebt. Das Tempo zählt, und unter einer ruhenden Nadel entspannt sich das Gewebe."],
  "help-more": ["Gamepad: the left stick pushes and slides, the right one turns; A starts and finishes, B resets. Alt and drag moves a zoomed picture, Ctrl and wheel zooms. Depth grows downwards from the probe; the dot marks the probe's marked side.", "Gamepad: der linke Stick schiebt und versetzt, der rechte dreht; A beginnt und beendet, B setzt zurück. Alt und Ziehen verschiebt ein vergrößertes Bild, Strg und Rad vergrößert. Die Tiefe wächst von der Sonde nach unten; der Punkt zeigt ihre markierte Seite."],
  "key-push": ["push, pull (with Shift slowly)", "schieben, ziehen (mit Umschalt langsam)"], "key-turn": ["turn", "drehen"], "key-entry": ["move the entry, needle out", "Einstich versetzen, Nadel draußen"], "key-reset": ["reset", "zurück"], "key-exercise": ["start or finish, next exercise", "beginnen oder beenden, nächste Übung"],
  "key-show": ["freeze, flip, invert", "einfrieren, spiegeln, umkehren"], "key-mark": ["measure, label, clear", "messen, Notiz, löschen"], "key-save": ["save picture, clip", "Bild, Film speichern"], "key-helps": ["guide, rings, numbers, motion", "Linie, Ringe, Zahlen, Bewegung"], "key-model": ["model", "Modell"], "key-sessions": ["my attempts", "meine Versuche"], "key-zoom": ["zoom in, out, fit", "vergrößern, verkleinern, einpassen"],
  "note-ask": ["What shall stand here?", "Was soll hier stehen?"], "write": ["Write", "Schreiben"], "cancel": ["Cancel", "Abbrechen"],
  "loading": ["Opening the scene...", "Die Szene wird geöffnet..."],
};
export const LANGUAGES = ["en", "de"];

/** Titles and goals of the exercises that every scene is given, where it brings none of its own: English to German. @type {Record<string, string>} */
const GIVEN = {
  "Hit the target": "Triff das Ziel", "Bring the tip into the ring. The tissue moves with the needle, and the target with it.": "Die Spitze in den Ring bringen. Das Gewebe geht mit der Nadel, und das Ziel mit ihm.",
  "One straight path": "Ein gerader Weg", "Choose entry and angle well: hit the deep target without turning the needle inside the tissue.": "Einstich und Winkel gut wählen: das tiefe Ziel treffen, ohne die Nadel im Gewebe zu drehen.",
  "Past the vessel": "Am Gefäß vorbei", "Reach the target behind the vessel without touching the vessel.": "Das Ziel hinter dem Gefäß erreichen, ohne das Gefäß zu berühren.",
  "Find and hit the target": "Finde und triff das Ziel", "Find the target with the probe, keep the needle in the picture and bring the tip into the target.": "Das Ziel mit der Sonde finden, die Nadel im Bild halten und die Spitze ins Ziel bringen.",
};

/** A title or goal in a language: one that a scene brings stays as it is. @param {string} text @param {string} language */
export function given(text, language) {
  return (language === "de" && Object.hasOwn(GIVEN, text) && GIVEN[text]) || text;
}

/** What `given` translates, for the tests. */
export const GIVEN_WORDS = Object.keys(GIVEN);

/** Words of a language; a key that the table lacks is a fault of the page. @param {string} language */
export function wordsOf(language) {
  const column = Math.max(0, LANGUAGES.indexOf(language));
  /** @param {string} key @param {Record<string, string | number>} [values] */
  return (key, values = {}) => {
    const entry = TABLE[key];
    if (!entry) throw new Error(`the table of words has no ${key}`);
    return entry[column].replace(/\{(\w+)\}/g, (_, name) => String(values[name] ?? ""));
  };
}

/** Keys of the table, for the tests. */
export const WORD_KEYS = Object.keys(TABLE);

/** A number as it is printed. @param {number} value */
export function printed(value) {
  if (Math.abs(value) < 0.005) return "0";
  return Number.isInteger(value) ? String(value) : value.toFixed(Math.abs(value) < 10 ? 2 : Math.abs(value) < 1000 ? 1 : 0);
}
