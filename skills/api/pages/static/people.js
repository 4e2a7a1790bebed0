// Forms that create or replace surgeons and suture types, by pseudonym or slug.
import { call } from "./api.js";
import { say } from "./site.js";

const forms = { surgeon: document.getElementById("surgeon"), suture: document.getElementById("suture") };
const uses = document.getElementById("uses");
const consented = forms.surgeon.elements.consented;
const showUses = () => (uses.hidden = !consented.checked);
consented.addEventListener("change", showUses);

const bodies = {
  surgeon(form) {
    const { skill_level: skill, handedness, protocol, until } = form.elements;
    const named = [...form.querySelectorAll('[name="uses"]:checked')].map((one) => one.value);
    const consent = consented.checked ? { uses: named, until: until.value || null } : null;
    return { skill_level: skill.value || null, handedness: handedness.value || null, protocol: protocol.value || null, consent };
  },
  suture(form) {
    const { slug, also_called: names, ...fields } = Object.fromEntries(new FormData(form));
    return { ...fields, also_called: names.split(",").map((one) => one.trim()).filter(Boolean) };
  },
};

// A change replaces the row: fields that the form does not have stay as they are.
const kept = {};
const unchanged = (kind, slug) => (kept[kind]?.slug === slug ? kept[kind].fields : {});

for (const [kind, form] of Object.entries(forms)) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const button = form.querySelector("button");
    say(button, "");
    try {
      const slug = form.elements.slug.value;
      await call("PUT", form.dataset.path + slug, { ...unchanged(kind, slug), ...bodies[kind](form) });
      location.reload();
    } catch (problem) {
      say(button, problem.message);
    }
  });
}

document.addEventListener("click", (event) => {
  const { fill, values } = event.target.closest(".edit")?.dataset ?? {};
  if (!fill) return;
  const form = forms[fill];
  const { slug, ...fields } = JSON.parse(values);
  kept[fill] = { slug, fields };
  for (const [name, value] of Object.entries({ slug, ...fields })) {
    const input = form.elements[name];
    if (input) input.value = Array.isArray(value) ? value.join(", ") : (value ?? "");
  }
  if (fill === "surgeon") {
    const { consent } = fields;
    consented.checked = consent !== null;
    form.querySelectorAll('[name="uses"]').forEach((one) => (one.checked = consent?.uses.includes(one.value) ?? false));
    form.elements.until.value = consent?.until ?? "";
    showUses();
  }
  document.getElementById(`${fill}-form`).open = true;
  form.elements.slug.focus();
});
