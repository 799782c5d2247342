//! Draws a crowded table as the three cameras see it, and the heightmap that they make:
//! `cargo run --release -p multiravens --example render -- FOLDER`.

use anyhow::{Context, Result};
use heightmap::{Camera, Fusion, Heightmap, Workspace, picture};
use multiravens::render::{Rasteriser, RgbdImage, crowded_table};
use std::path::PathBuf;

fn main() -> Result<()> {
    let folder = std::env::args_os().nth(1).map(PathBuf::from);
    let folder = folder.context("expected the folder for the pictures")?;
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let cameras = Camera::ravens();
    let mut images = cameras.each_ref().map(|c| RgbdImage::new(&c.intrinsics));
    let (scene, mut rasteriser) = (crowded_table(), Rasteriser::new());
    for (camera, image) in cameras.iter().zip(&mut images) {
        rasteriser.render(&scene, camera, &mut image.rgb, &mut image.depth_m)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let path = folder.join(format!("{}.png", camera.name));
        picture::write(&path, &picture::camera(width, height, &image.rgb))?;
        println!("{}", path.display());
    }
    let views = [0, 1, 2].map(|i| images[i].view(&cameras[i]));
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    let report = Fusion::default().fuse(&views, &mut heightmap)?;
    let path = folder.join("heightmap.png");
    picture::write_heightmap(&path, &heightmap, None)?;
    println!(
        "{}: {} views, {:.1} % of the cells seen",
        path.display(),
        report.views,
        100.0 * report.coverage
    );
    Ok(())
}
