// Before the first paint: day or night, as the switch, the address (?theme=night) or the system says.
(function () {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const kept = () => {
    const asked = new URLSearchParams(location.search).get("theme");
    if (["auto", "day", "night"].includes(asked)) return asked;
    try { return localStorage.getItem("theme") || "auto"; } catch { return "auto"; }
  };
  const apply = (choice) => {
    const night = choice === "night" || (choice !== "day" && dark.matches);
    document.documentElement.dataset.theme = night ? "night" : "day";
  };
  let choice = kept();
  apply(choice);
  dark.addEventListener("change", () => apply(choice));
  window.chooseTheme = (wanted) => apply((choice = wanted));
})();
