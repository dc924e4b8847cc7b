const films = [...document.querySelectorAll('video')];
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
const together = () => films.forEach(film => { film.currentTime = 0; film.play(); });
document.getElementById('together')?.addEventListener('click', together);
if (!calm) addEventListener('load', together);
