"use strict";
// Shows the scenes that hold every category that is ticked, and says how many these are.

const boxes = [...document.querySelectorAll("#filter input")];
const scenes = [...document.querySelectorAll("article.scene")];
function filterScenes() {
  const wanted = boxes.filter((box) => box.checked).map((box) => box.value);
  let shown = 0;
  for (const scene of scenes) {
    const held = JSON.parse(scene.dataset.categories);
    scene.hidden = !wanted.every((category) => held.includes(category));
    shown += scene.hidden ? 0 : 1;
  }
  const count = document.querySelector("#filter output");
  if (count) count.textContent = `${shown} of ${scenes.length} scenes shown`;
}
for (const box of boxes) box.addEventListener("change", filterScenes);
filterScenes();
