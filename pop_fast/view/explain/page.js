(() => {
  const light = id => {
    document.querySelectorAll('[data-id].on').forEach(e => e.classList.remove('on'));
    document.querySelectorAll('.stage').forEach(e => e.classList.toggle('any', id !== null && !!e.querySelector(`[data-id="${id}"]`)));
    if (id !== null) document.querySelectorAll(`[data-id="${id}"]`).forEach(e => e.classList.add('on'));
  };
  document.addEventListener('pointerover', event => {
    const hit = event.target.closest('[data-id]');
    light(hit ? hit.dataset.id : null);
  });
  const box = document.getElementById('all');
  if (box) box.addEventListener('change', () => document.body.classList.toggle('all', box.checked));
})();
