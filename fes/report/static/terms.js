"use strict";
// What a word means: on hover, on keyboard focus and on touch. The texts stand in the page's own list of definitions.
(() => {
  const tip = document.createElement("div");
  tip.id = "tip";
  tip.setAttribute("role", "tooltip");
  tip.hidden = true;
  document.body.append(tip);
  let shown = null;

  const meaning = (term) => {
    const told = document.getElementById(term.hash.slice(1));
    const own = term.dataset.more ? term.dataset.more + " " : "";
    return told ? own + told.textContent.trim() + ": " + told.nextElementSibling.textContent.trim() : own;
  };
  const hide = () => {
    if (shown) shown.removeAttribute("aria-describedby");
    shown = null;
    tip.hidden = true;
  };
  const show = (term) => {
    if (shown === term) return;
    hide();
    tip.textContent = meaning(term);
    if (!tip.textContent) return;
    shown = term;
    term.setAttribute("aria-describedby", "tip");
    tip.hidden = false;
    const room = document.documentElement;
    const at = term.getBoundingClientRect(), own = tip.getBoundingClientRect();
    const left = Math.min(Math.max(8, at.left), room.clientWidth - own.width - 8);
    const below = at.bottom + 6 + own.height < room.clientHeight || at.top < own.height + 6;
    tip.style.left = left + "px";
    tip.style.top = (below ? at.bottom + 6 : at.top - own.height - 6) + "px";
  };
  const termOf = (event) => (event.target.closest ? event.target.closest("a.term") : null);

  document.addEventListener("mouseover", (event) => {
    const term = termOf(event);
    if (term) show(term);
    else if (!tip.contains(event.target) && document.activeElement !== shown) hide();
  });
  document.addEventListener("focusin", (event) => { const term = termOf(event); if (term) show(term); else hide(); });
  document.addEventListener("focusout", (event) => { if (termOf(event)) hide(); });
  document.addEventListener("click", (event) => {
    const term = termOf(event);
    if (term) { event.preventDefault(); show(term); } else if (!tip.contains(event.target)) hide();
  });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
  window.addEventListener("scroll", () => { if (document.activeElement !== shown) hide(); }, { passive: true, capture: true });
})();
