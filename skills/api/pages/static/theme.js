// Light or dark as the person chose, before anything is drawn; without a choice, as the system is.
{
  const chosen = localStorage.getItem("theme");
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
}
