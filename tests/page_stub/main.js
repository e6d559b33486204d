import { load } from "./echospline.js";

/** Bytes that an element holds, inflated. @param {string} id @returns {Promise<Uint8Array>} */
async function held(id) {
  const text = document.getElementById(id).textContent;
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const core = await load(await held("core"));
const scene = await held("scene");
document.getElementById("said").textContent = `core ${core.version}, scene of ${scene.length} bytes`;
