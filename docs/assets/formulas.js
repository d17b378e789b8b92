// Formulas between dollars, set by KaTeX.
document.addEventListener("DOMContentLoaded", () => {
  for (const host of document.querySelectorAll(".arithmatex")) {
    const displayMode = host.tagName === "DIV";
    katex.render(host.textContent.trim().slice(2, -2), host, { displayMode, throwOnError: false });
  }
});
