// The player in its frame: one shell (gesturekit/viewer), filled with the clip that is asked for.
const shell = JSON.parse(document.getElementById("shell").textContent);
const clips = JSON.parse(document.getElementById("clips").textContent);
const buttons = [...document.querySelectorAll("#clips-bar button")];

function show(index) {
  const { title, motion } = clips[index];
  document.getElementById("player").srcdoc = shell
    .replaceAll("{{title}}", () => title)
    .replace("{{motion}}", () => motion);
  buttons.forEach((button, i) => button.setAttribute("aria-pressed", i === index));
}

buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
show(0);
