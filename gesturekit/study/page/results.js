// The answers of one rater as CSV. Comparisons: GENEA's columns, then our own (see
// evaluation/statistics/answers.py); ratings: a line for each slider (evaluation/statistics/ratings.py).

const OF_RATER = ["study", "checks", "checks_failed", "comment", "list", "study_id", "session_id", "finished"];
export const COLUMNS = [
  "user", "input_code", "model_a", "model_b", "winner", "is_strong", "juiceOptions", "juiceOtherReason",
  "trial", "answer", "style", "seconds", "plays_left", "plays_right", ...OF_RATER,
];
const RATING_COLUMNS = [
  "rater", "system", "clip", "question", "value", "trial", "position", "seconds", "plays", ...OF_RATER,
];
const TOLERANCE = 5; // of a slider in an attention check

const cell = (value) => {
  const text = String(value ?? "");
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};

function comparison(trial) {
  const { answer } = trial;
  const winner = answer === "TheyAreEqual" ? "tie" : answer.startsWith("Left") ? "model_a" : "model_b";
  return [{
    input_code: trial.clip,
    model_a: trial.systems[0],
    model_b: trial.systems[1],
    winner,
    is_strong: winner === "tie" ? "" : answer.includes("Clearly") ? "True" : "False",
    juiceOptions: trial.reasons.length ? JSON.stringify(trial.reasons) : "{}",
    juiceOtherReason: trial.other ? JSON.stringify(trial.other) : "",
    answer,
    style: trial.style ?? "",
    seconds: trial.seconds,
    plays_left: trial.plays[0],
    plays_right: trial.plays[1],
  }];
}

const ratings = (trial) => trial.values.map((value, i) => ({
  system: trial.systems[i],
  clip: trial.clip,
  question: trial.question,
  value,
  position: i + 1,
  seconds: trial.seconds,
  plays: trial.plays[i],
}));

const passed = (trial) => (trial.values
  ? Math.abs(trial.values[trial.checked] - trial.expected) <= TOLERANCE
  : trial.answer === trial.expected);

export function toCsv(rater, trials) {
  const asked = trials.filter((trial) => "expected" in trial);
  const about = { ...rater, rater: rater.user, checks: asked.length, checks_failed: asked.filter((trial) => !passed(trial)).length };
  const lines = trials.flatMap((trial, i) => ("expected" in trial ? [] : trial.values ? ratings(trial) : comparison(trial))
    .map((line) => ({ ...about, ...line, trial: i + 1 })));
  const columns = trials.some((trial) => trial.values) ? RATING_COLUMNS : COLUMNS;
  return [columns, ...lines.map((line) => columns.map((name) => line[name]))]
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
