// Where millimetres lie on the screen: made from the state when it is needed, stored by nobody.

/** @import { Point } from "./scene.js" */
/** @typedef {{ x0: number, y0: number, x1: number, y1: number }} Extent mm */
/**
 * How the picture is shown: size of the stage in CSS pixels, zoom and pan, left and right exchanged, depth that is seen (mm),
 * and the share of the width that is left free at the right where there is room.
 * @typedef {{ width: number, height: number, zoom: number, pan: Point, flip: boolean, depth: number, aside: number }} ViewState
 */
/**
 * A snapshot of the way between screen and picture; `area` is where the picture may be seen, CSS pixels.
 * @typedef {{
 *   scale: number, flip: boolean, area: { left: number, top: number, right: number, bottom: number }, extent: Extent,
 *   toScreen: (mm: ArrayLike<number>) => Point, toMm: (pixel: Point) => Point
 * }} View
 */

export const MOST_ZOOM = 12;
const MARGIN = { top: 74, right: 44, bottom: 16, left: 16 }; // CSS pixels: probe and needle above, ruler on the right
const LOW_MARGIN = { top: 52, right: 40, bottom: 8, left: 8 }; // on a stage that is less than LOW high
const LEAST_ASIDE = 120, MOST_ASIDE = 270; // CSS pixels
const LOW = 420; // CSS pixels

/** @param {ViewState} view @param {Extent} extent @returns {View} */
export function viewOf(view, extent) {
  const margin = view.height < LOW ? LOW_MARGIN : MARGIN;
  const across = extent.x1 - extent.x0, down = Math.min(view.depth, extent.y1 - extent.y0);
  const room = [Math.max(20, view.width - margin.left - margin.right), Math.max(20, view.height - margin.top - margin.bottom)];
  const fit = Math.min(room[0] / across, room[1] / down), scale = fit * view.zoom, sign = view.flip ? -1 : 1;
  const middling = margin.left + (room[0] - fit * across) / 2, free = view.width - asideOf(view) - margin.right - fit * across;
  const left = view.aside ? Math.max(margin.left, Math.min(middling, free)) : middling, top = margin.top + (room[1] - fit * down) / 2;
  const middle = left + (fit * across) / 2 + view.pan[0], shift = top + view.pan[1];
  const centre = (extent.x0 + extent.x1) / 2;
  return {
    scale, flip: view.flip, extent,
    area: { left: view.zoom > 1 ? margin.left : left, top, right: view.zoom > 1 ? view.width - margin.right : left + fit * across, bottom: top + fit * down },
    toScreen: (mm) => [middle + sign * scale * (mm[0] - centre), shift + scale * (mm[1] - extent.y0)],
    toMm: (pixel) => [centre + (sign * (pixel[0] - middle)) / scale, extent.y0 + (pixel[1] - shift) / scale],
  };
}

/** Width that is left free at the right, CSS pixels. @param {ViewState} view */
export function asideOf({ width, aside }) {
  return aside ? Math.max(LEAST_ASIDE, Math.min(MOST_ASIDE, aside * width)) : 0;
}

/** Zoom about a point of the screen, which stays where it is. @param {ViewState} view @param {Extent} extent @param {number} factor @param {Point} about @returns {ViewState} */
export function zoomed(view, extent, factor, about) {
  const place = viewOf(view, extent).toMm(about);
  const zoom = Math.min(MOST_ZOOM, Math.max(1, view.zoom * factor));
  const next = { ...view, zoom, pan: zoom === 1 ? /** @type {Point} */ ([0, 0]) : view.pan };
  if (zoom === 1) return next;
  const now = viewOf(next, extent).toScreen(place);
  return { ...next, pan: [next.pan[0] + about[0] - now[0], next.pan[1] + about[1] - now[1]] };
}
