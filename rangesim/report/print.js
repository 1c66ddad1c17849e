"use strict";
// Before the page is printed: each sheet gets the largest pictures and then the largest text with which it fits on a page.

const PAPER_MM = { width: 186, height: 252 };  // A4's width and Letter's height, less margins of 12 mm, and 3 mm to spare
const TEXT_PT = [9, 8.5, 8, 7.5, 7, 6.5, 6, 5.5, 5, 4.5, 4];
const READABLE_PT = 7;  // text becomes smaller only after the pictures
const TALL_MM = Array.from({ length: 39 }, (_, k) => 91 - 2 * k);  // largest height of a picture, to 15 mm

function fitSheet(sheet) {
  const mm = 96 / 25.4;
  const fits = (text, tall) => {
    sheet.style.setProperty("--text", text);
    sheet.style.setProperty("--tall", tall);
    return sheet.scrollWidth <= PAPER_MM.width * mm + 1 && sheet.offsetHeight <= PAPER_MM.height * mm;
  };
  const readable = TEXT_PT.filter((text) => text >= READABLE_PT), smaller = TEXT_PT.filter((text) => text < READABLE_PT);
  return TALL_MM.some((tall) => readable.some((text) => fits(text, tall))) || smaller.some((text) => fits(text, TALL_MM.at(-1)));
}

window.addEventListener("beforeprint", () => {
  const print = document.getElementById("print");
  print.media = "all";
  document.querySelectorAll(".sheet").forEach(fitSheet);
  print.media = "print";
});
