"use strict";
// Before the page is printed: each sheet gets the largest pictures and the largest text with which it fits on a page.

const PAPER_MM = { width: 186, height: 252 };  // A4's width and Letter's height, less margins of 12 mm, and 3 mm to spare
const TEXT_PT = { largest: 9, readable: 7, smallest: 3.5 };  // below the readable size, text shrinks only after the pictures
const PICTURE_MM = { largest: 90, smallest: 15 };  // height

// The largest number between two limits of which a condition is true; the smaller limit if it is true of none.
function largest({ smallest, largest }, isTrue, step) {
  let low = smallest, high = largest + step;
  while (high - low > step) {
    const middle = (low + high) / 2;
    if (isTrue(middle)) low = middle; else high = middle;
  }
  return low;
}

function fitSheet(sheet) {
  const mm = 96 / 25.4;
  const set = (text, picture) => {
    sheet.style.setProperty("--text", text);
    sheet.style.setProperty("--picture", picture);
  };
  const fits = (text, picture) => {
    set(text, picture);
    return sheet.scrollWidth <= PAPER_MM.width * mm + 1 && sheet.offsetHeight <= PAPER_MM.height * mm;
  };
  const text = largest({ smallest: TEXT_PT.smallest, largest: TEXT_PT.readable }, (size) => fits(size, PICTURE_MM.smallest), 0.1);
  const picture = largest(PICTURE_MM, (height) => fits(text, height), 1);
  set(largest({ smallest: text, largest: TEXT_PT.largest }, (size) => fits(size, picture), 0.1), picture);
}

// Calls a function while the rules for print hold on the screen, and those for the screen do not.
function asPrinted(measure) {
  const rules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules]).filter((rule) => rule.media);
  const usual = rules.map((rule) => rule.media.mediaText);
  for (const { media } of rules) media.mediaText = media.mediaText === "print" ? "all" : "not all";
  measure();
  rules.forEach((rule, k) => { rule.media.mediaText = usual[k]; });
}

window.addEventListener("beforeprint", () => asPrinted(() => document.querySelectorAll(".sheet").forEach(fitSheet)));
