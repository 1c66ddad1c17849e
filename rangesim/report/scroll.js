"use strict";
// Tables that are wider than the page say that they scroll.

function markScrolling() {
  for (const box of document.querySelectorAll(".scroll")) box.classList.toggle("scrolls", box.scrollWidth > box.clientWidth);
}
window.addEventListener("resize", markScrolling);
markScrolling();
