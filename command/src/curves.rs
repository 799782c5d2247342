//! Learning curves as pictures.

use anyhow::{Context, Result, anyhow};
use learning::{Cell, Table};
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const SIZE: (u32, u32) = (900, 540);

/// Draws a picture for each problem of the table into a folder.
pub fn draw(table: &Table, folder: &Path) -> Result<Vec<PathBuf>> {
    register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular())
        .map_err(|_| anyhow!("the font cannot be read"))?;
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let mut problems: BTreeMap<&str, Vec<&Cell>> = BTreeMap::new();
    for cell in &table.cells {
        problems.entry(&cell.problem).or_default().push(cell);
    }
    let mut paths = Vec::new();
    for (problem, cells) in problems {
        let path = folder.join(format!("{problem}.png"));
        let pixels = chart(problem, &cells).with_context(|| path.display().to_string())?;
        image::RgbImage::from_raw(SIZE.0, SIZE.1, pixels)
            .context("the picture's size")?
            .save(&path)
            .with_context(|| path.display().to_string())?;
        paths.push(path);
    }
    Ok(paths)
}

/// Completion over gradient steps.
fn chart(problem: &str, cells: &[&Cell]) -> Result<Vec<u8>> {
    let steps = cells
        .iter()
        .flat_map(|cell| &cell.curve)
        .map(|(step, _)| *step);
    let last = steps.max().unwrap_or(1);
    let mut pixels = vec![255; (3 * SIZE.0 * SIZE.1) as usize];
    {
        let area = BitMapBackend::with_buffer(&mut pixels, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .caption(problem.replace('_', " + "), ("sans-serif", 22))
            .margin(12)
            .x_label_area_size(44)
            .y_label_area_size(56)
            .build_cartesian_2d(0..last, 0.0..100.0)?;
        chart
            .configure_mesh()
            .x_desc("gradient steps")
            .y_desc("completion on test episodes, %")
            .label_style(("sans-serif", 15))
            .draw()?;
        for (index, cell) in cells.iter().enumerate() {
            let color = Palette99::pick(index).to_rgba();
            let points = cell.curve.iter().map(|(step, rate)| (*step, 100.0 * rate));
            let points: Vec<_> = std::iter::once((0, 0.0)).chain(points).collect();
            let label = format!("{}, {} demonstrations", cell.agent, cell.demonstrations);
            chart
                .draw_series(LineSeries::new(points.clone(), color.stroke_width(2)))?
                .label(label)
                .legend(move |(x, y)| {
                    PathElement::new([(x, y), (x + 22, y)], color.stroke_width(2))
                });
            let dots = points.into_iter().skip(1);
            chart.draw_series(dots.map(|point| Circle::new(point, 3, color.filled())))?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .label_font(("sans-serif", 15))
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?;
        area.present()?;
    }
    Ok(pixels)
}
