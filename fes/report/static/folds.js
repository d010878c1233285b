"use strict";
// A link into a fold opens it; what is drawn to a width is drawn anew then.
(() => {
  const open = () => {
    const to = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (let up = to; up; up = up.parentElement) if (up.localName === "details") up.open = true;
    if (to) to.scrollIntoView({ behavior: "instant" });
  };
  window.addEventListener("hashchange", open);
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[href^='#']:not(.term)");
    if (link && link.hash === location.hash) open();
  });
  for (const fold of document.querySelectorAll("details.role")) {
    fold.addEventListener("toggle", () => window.dispatchEvent(new Event("resize")));
  }
  open();
})();
