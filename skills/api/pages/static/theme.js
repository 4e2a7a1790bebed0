// Apply the user's theme, light or dark, before the first paint; without a choice, that of the system.
{
  const chosen = localStorage.getItem("theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
}
