// The answers of one rater as CSV: GENEA's columns, then our own (see evaluation/statistics/answers.py).

export const COLUMNS = [
  "user", "input_code", "model_a", "model_b", "winner", "is_strong", "juiceOptions", "juiceOtherReason",
  "study", "trial", "answer", "style", "seconds", "plays_left", "plays_right",
  "checks", "checks_failed", "list", "study_id", "session_id", "finished",
];

const cell = (value) => {
  const text = String(value ?? "");
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};

function row(rater, trial, index, checks) {
  const { answer } = trial;
  const winner = answer === "TheyAreEqual" ? "tie" : answer.startsWith("Left") ? "model_a" : "model_b";
  return {
    ...rater,
    ...checks,
    input_code: trial.clip,
    model_a: trial.systems[0],
    model_b: trial.systems[1],
    winner,
    is_strong: winner === "tie" ? "" : answer.includes("Clearly") ? "True" : "False",
    juiceOptions: trial.reasons.length ? JSON.stringify(trial.reasons) : "{}",
    juiceOtherReason: trial.other ? JSON.stringify(trial.other) : "",
    trial: index + 1,
    answer,
    style: trial.style ?? "",
    seconds: trial.seconds,
    plays_left: trial.plays[0],
    plays_right: trial.plays[1],
  };
}

export function toCsv(rater, trials) {
  const asked = trials.filter((trial) => trial.expected);
  const checks = {
    checks: asked.length,
    checks_failed: asked.filter((trial) => trial.answer !== trial.expected).length,
  };
  const lines = trials
    .map((trial, i) => [trial, i])
    .filter(([trial]) => !trial.expected)
    .map(([trial, i]) => row(rater, trial, i, checks));
  return [COLUMNS, ...lines.map((line) => COLUMNS.map((name) => line[name]))]
    .map((cells) => cells.map(cell).join(",") + "\r\n")
    .join("");
}

export function download(text, name) {
  const url = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

// Sent as a plain text, which needs no permission of the server in advance (no CORS preflight).
export async function post(text, url) {
  const answer = await fetch(url, { method: "POST", body: text, headers: { "Content-Type": "text/plain;charset=UTF-8" } });
  if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
}
