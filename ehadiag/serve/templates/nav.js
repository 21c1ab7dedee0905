"use strict";
// The token of the printed address goes along from page to page.
for (const link of document.querySelectorAll("nav a")) link.hash = location.hash;
