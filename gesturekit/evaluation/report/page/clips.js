// The player in its frame: one shell (gesturekit/viewer), filled with the clip that is asked for.
// The player's state ("ready", "failed") is told on the page's root element, for who waits for it.
const shell = JSON.parse(document.getElementById("shell").textContent);
const clips = JSON.parse(document.getElementById("clips").textContent);
const buttons = [...document.querySelectorAll("#clips-bar button")];
const frame = document.getElementById("player");

function show(index) {
  const { title, motion } = clips[index];
  frame.srcdoc = shell.replaceAll("{{title}}", () => title).replace("{{motion}}", () => motion);
  buttons.forEach((button, i) => button.setAttribute("aria-pressed", i === index));
}

frame.addEventListener("load", function tell() {
  const { state } = frame.contentDocument.documentElement.dataset;
  document.documentElement.dataset.player = state ?? "loading";
  if (!state) setTimeout(tell, 50);
});
buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
show(0);
