// The calls, read from the OpenAPI document and drawn by Swagger UI, whose script is loaded before this one.
import { root } from "./api.js";

const dark = matchMedia("(prefers-color-scheme: dark)");

// Swagger UI has a dark theme of its own, switched on by a class.
function followTheme() {
  const { theme } = document.documentElement.dataset;
  document.documentElement.classList.toggle("dark-mode", theme ? theme === "dark" : dark.matches);
}

document.addEventListener("theme", followTheme);
followTheme();
SwaggerUIBundle({
  url: `${root}/openapi.json`,
  dom_id: "#calls",
  docExpansion: "list",
  deepLinking: true,
  filter: true,
  displayOperationId: true,
  defaultModelsExpandDepth: 0,
  validatorUrl: null,  // no outside address
  onComplete: () => document.querySelector("#calls main")?.setAttribute("role", "group"),  // the page has one already
});
