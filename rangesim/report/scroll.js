"use strict";
// Marks tables that are wider than the page, so that they show a hint that they scroll, and keys can scroll them.

function markScrolling() {
  for (const box of document.querySelectorAll(".scroll")) {
    const scrolls = box.scrollWidth > box.clientWidth;
    box.classList.toggle("scrolls", scrolls);
    for (const [name, value] of [["tabindex", "0"], ["role", "group"], ["aria-label", "table, wider than the page"]]) {
      if (scrolls) box.setAttribute(name, value); else box.removeAttribute(name);
    }
  }
}
window.addEventListener("resize", markScrolling);
markScrolling();
