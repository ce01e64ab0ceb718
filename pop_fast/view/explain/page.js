(() => {
  const light = id => {
    document.querySelectorAll('[data-id].on').forEach(e => e.classList.remove('on'));
    document.querySelectorAll('.stage').forEach(e => e.classList.toggle('any', id !== null && !!e.querySelector(`[data-id="${id}"]`)));
    if (id !== null) document.querySelectorAll(`[data-id="${id}"]`).forEach(e => e.classList.add('on'));
  };
  // a line of the table is also reached by the keyboard
  for (const kind of ['pointerover', 'focusin']) document.addEventListener(kind, event => {
    const hit = event.target.closest('[data-id]');
    light(hit ? hit.dataset.id : null);
  });
  const box = document.getElementById('all');
  if (box) box.addEventListener('change', () => document.body.classList.toggle('all', box.checked));
})();
