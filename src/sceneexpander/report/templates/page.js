"use strict";
for (const player of document.querySelectorAll("[data-player]")) {
  const videos = [...player.querySelectorAll("video")];
  const play = player.querySelector("[data-play]");
  const seek = player.querySelector("[data-seek]");
  const lead = videos[0];
  if (!lead) continue;
  let holding = false;
  const length = () => lead.duration || 1;
  const each = (act) => videos.forEach(act);
  const label = () => { play.textContent = lead.paused ? "Play" : "Pause"; };
  const goTo = (share) => each((video) => { if (video.duration) video.currentTime = share * video.duration; });
  play.addEventListener("click", () => {
    const start = lead.paused;
    each((video) => { if (start) video.play().catch(() => {}); else video.pause(); });
    if (!start) goTo(lead.currentTime / length());
  });
  lead.addEventListener("play", label);
  lead.addEventListener("pause", label);
  lead.addEventListener("timeupdate", () => {
    if (!holding) seek.value = lead.currentTime / length();
    // Followers drift by a few frames when the machine is busy; pull them back only when it shows.
    for (const video of videos.slice(1)) {
      if (video.duration && Math.abs(video.currentTime - lead.currentTime) > 0.12) video.currentTime = lead.currentTime;
    }
  });
  seek.addEventListener("input", () => { holding = true; each((video) => video.pause()); goTo(Number(seek.value)); });
  seek.addEventListener("change", () => { holding = false; });
  const jump = player.querySelector("[data-jump]");
  jump.addEventListener("click", () => { each((video) => video.pause()); each((video) => { if (video.duration) video.currentTime = Number(video.dataset.goal) * video.duration; }); });
  const tabs = [...player.querySelectorAll("[data-layer]")];
  for (const tab of tabs) {
    tab.addEventListener("click", () => {
      const share = lead.currentTime / length();
      const running = !lead.paused;
      tabs.forEach((other) => other.setAttribute("aria-selected", String(other === tab)));
      player.querySelectorAll("[data-legend]").forEach((text) => { text.hidden = text.dataset.legend !== tab.dataset.layer; });
      each((video) => {
        const source = video.dataset[tab.dataset.layer];
        if (!source) return;
        video.removeAttribute("poster");
        video.src = source;
        video.addEventListener("loadedmetadata", () => {
          video.currentTime = share * video.duration;
          if (running) video.play().catch(() => {});
        }, { once: true });
      });
    });
  }
}
