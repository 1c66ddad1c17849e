"use strict";
// Marks tables that are wider than the page, so that they show a hint that they scroll, and keys can scroll them.

function markScrolling() {
  for (const box of document.querySelectorAll(".scroll")) {
    const scrolls = box.scrollWidth > box.clientWidth;
    box.classList.toggle("scrolls", scrolls);
    if (scrolls) Object.assign(box, { tabIndex: 0, role: "group", ariaLabel: "table, wider than the page" });
    else for (const name of ["tabindex", "role", "aria-label"]) box.removeAttribute(name);
  }
}
window.addEventListener("resize", markScrolling);
markScrolling();
