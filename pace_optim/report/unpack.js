"use strict";
// What is large on the page is packed (gzip, base64). The other scripts begin when it is unpacked.
const pace = {
  /** A curve: differences of whole multiples of a step; null where it is not a number. */
  curve({ step, by }) {
    let sum = 0;
    return Float64Array.from(by, (difference) => (difference === null ? NaN : (sum += difference) * step));
  },
  async text(packed) {
    const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  },
};
pace.ready = (async () => {
  for (const packed of document.querySelectorAll("script[data-packed]")) {
    const script = document.createElement("script");
    script.type = packed.dataset.packed;
    script.textContent = await pace.text(packed.textContent);
    packed.replaceWith(script);
  }
})();
pace.ready.catch(() => {
  const note = document.createElement("p");
  note.className = "lead";
  note.textContent = "This browser cannot unpack the figures. Use one of 2023 or later.";
  document.querySelector("main").prepend(note);
});
