"use strict";
// Marks tables that are wider than the page, so that they show a hint that they scroll.

function markScrolling() {
  for (const box of document.querySelectorAll(".scroll")) box.classList.toggle("scrolls", box.scrollWidth > box.clientWidth);
}
window.addEventListener("resize", markScrolling);
markScrolling();
