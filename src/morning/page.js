(function () {
  var table = document.querySelector("table.scans");
  if (!table) return;
  var groups = Array.from(table.tBodies), heads = Array.from(table.tHead.rows[0].cells);
  function sort(column, down) {
    groups.sort(function (a, b) {
      var x = a.dataset["k" + column], y = b.dataset["k" + column];
      if (x === "" || y === "") return (x === "") - (y === "");
      var d = isNaN(x) || isNaN(y) ? x.localeCompare(y, undefined, { numeric: true }) : x - y;
      return down ? -d : d;
    });
    groups.forEach(function (g) { table.appendChild(g); });
    heads.forEach(function (h, i) {
      if (i === column) h.setAttribute("aria-sort", down ? "descending" : "ascending");
      else h.removeAttribute("aria-sort");
    });
  }
  heads.forEach(function (h, i) {
    var button = h.querySelector("button");
    if (button) button.onclick = function () { sort(i, h.getAttribute("aria-sort") === "ascending"); };
  });
  var chosen = document.getElementById("sort");
  if (chosen) chosen.onchange = function () { var v = chosen.value.split(" "); sort(+v[0], v[1] === "down"); };
  function turn(group) {
    var open = group.classList.toggle("open");
    group.querySelector("tr.row").setAttribute("aria-expanded", open);
    var image = group.querySelector("img");
    if (image) (open ? group.querySelector(".strip") : group.querySelector(".thumb")).appendChild(image);
  }
  groups.forEach(function (g) {
    var row = g.querySelector("tr.row");
    row.onclick = function (e) { if (!e.target.closest("a,code")) turn(g); };
    row.onkeydown = function (e) { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); turn(g); } };
  });
  var search = document.getElementById("search"), found = document.getElementById("found");
  if (search) search.oninput = function () {
    var words = search.value.toLowerCase(), n = 0;
    groups.forEach(function (g) {
      var is = g.dataset.k1.toLowerCase().indexOf(words) >= 0;
      g.style.display = is ? "" : "none";
      n += is;
    });
    found.textContent = words ? n + " of " + groups.length : "";
  };
  var ways = Array.from(document.querySelectorAll("[data-as]"));
  ways.forEach(function (way) {
    way.onclick = function () {
      table.classList.toggle("cards", way.dataset.as === "cards");
      ways.forEach(function (other) { other.setAttribute("aria-pressed", other === way); });
    };
  });
  document.querySelectorAll("a[data-scan]").forEach(function (a) {
    a.onclick = function () {
      var g = document.getElementById(a.getAttribute("href").slice(1));
      if (g && !g.classList.contains("open")) turn(g);
    };
  });
})();
