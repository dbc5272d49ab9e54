const images=JSON.parse(document.getElementById('images').textContent);
const show=img=>{img.src='data:image/jpeg;base64,'+images[img.dataset.i]};
document.querySelectorAll('img[data-i]').forEach(show);
document.querySelectorAll('.view').forEach(view=>{
const slider=view.querySelector('.slider'),over=view.querySelector('.over'),range=view.querySelector('input'),
pick=view.querySelector('select'),tag=view.querySelector('.right');
const move=()=>{over.style.clipPath='inset(0 0 0 '+range.value+'%)';
slider.style.setProperty('--at',range.value+'%')};
const swap=()=>{over.dataset.i=pick.value;show(over);tag.textContent=pick.selectedOptions[0].textContent};
range.addEventListener('input',move);pick.addEventListener('change',swap);move();swap();});
