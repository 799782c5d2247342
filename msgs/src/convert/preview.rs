//! Heightmaps as RViz and Foxglove show them.

use super::ConvertError;
use crate::{geometry_msgs, grid_map_msgs, sensor_msgs, std_msgs};
use ::heightmap::{Heightmap, Pixel};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde_bytes::ByteBuf;

/// The layers `elevation` (metres) and `color` (RViz's packed red, green, blue).
///
/// A grid map is a column-major matrix whose row index grows against x and whose column index grows against y,
/// from the corner of the largest x and y. Ours is row-major with rows along +y and columns along +x from the
/// corner of the smallest: the same values in reverse order.
pub fn grid_map(heightmap: &Heightmap, header: std_msgs::Header) -> grid_map_msgs::GridMap {
    let workspace = &heightmap.workspace;
    let (length_x, length_y) = (
        workspace.cols as f64 * workspace.pixel_size_m,
        workspace.rows as f64 * workspace.pixel_size_m,
    );
    let position = geometry_msgs::Point {
        x: workspace.origin_m.x + length_x / 2.0,
        y: workspace.origin_m.y + length_y / 2.0,
        z: 0.0,
    };
    let dimension = |label: &str, size: usize, stride: usize| std_msgs::MultiArrayDimension {
        label: label.to_owned(),
        size: size as u32,
        stride: stride as u32,
    };
    let layout = std_msgs::MultiArrayLayout {
        dim: vec![
            dimension("column_index", workspace.rows, workspace.len()),
            dimension("row_index", workspace.cols, workspace.cols),
        ],
        data_offset: 0,
    };
    let layer = |data| std_msgs::Float32MultiArray {
        layout: layout.clone(),
        data,
    };
    let packed = |&[r, g, b]: &[u8; 3]| f32::from_bits(u32::from_be_bytes([0, r, g, b]));
    grid_map_msgs::GridMap {
        header,
        info: grid_map_msgs::GridMapInfo {
            resolution: workspace.pixel_size_m,
            length_x,
            length_y,
            pose: geometry_msgs::Pose {
                position,
                ..Default::default()
            },
        },
        layers: vec!["elevation".to_owned(), "color".to_owned()],
        basic_layers: vec!["elevation".to_owned()],
        data: vec![
            layer(heightmap.height_m.iter().rev().copied().collect()),
            layer(
                heightmap
                    .rgb
                    .as_chunks::<3>()
                    .0
                    .iter()
                    .rev()
                    .map(packed)
                    .collect(),
            ),
        ],
        outer_start_index: 0,
        inner_start_index: 0,
    }
}

/// The colours as an image of encoding rgb8 whose rows and columns are those of the heightmap: x runs right,
/// y runs down.
pub fn preview_image(
    heightmap: &Heightmap,
    header: std_msgs::Header,
) -> Result<sensor_msgs::Image, ConvertError> {
    let workspace = &heightmap.workspace;
    super::error::size("rgb", heightmap.rgb.len(), 3 * workspace.len())?;
    Ok(sensor_msgs::Image {
        header,
        height: workspace.rows as u32,
        width: workspace.cols as u32,
        encoding: "rgb8".to_owned(),
        is_bigendian: 0,
        step: 3 * workspace.cols as u32,
        data: ByteBuf::from(heightmap.rgb.clone()),
    })
}

/// The same as a PNG.
pub fn compressed_preview(
    heightmap: &Heightmap,
    header: std_msgs::Header,
) -> Result<sensor_msgs::CompressedImage, ConvertError> {
    let workspace = &heightmap.workspace;
    super::error::size("rgb", heightmap.rgb.len(), 3 * workspace.len())?;
    let mut png = Vec::new();
    // Fast rather than small.
    let encoder =
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive);
    encoder
        .write_image(
            &heightmap.rgb,
            workspace.cols as u32,
            workspace.rows as u32,
            ExtendedColorType::Rgb8,
        )
        .map_err(|error| super::error::unexpected("rgb", error, "an image"))?;
    Ok(sensor_msgs::CompressedImage {
        header,
        format: "png".to_owned(),
        data: ByteBuf::from(png),
    })
}

/// One coloured point a cell, at its centre, as RViz, Foxglove and PCL read them: x, y, z, and rgb packed in a
/// float. Rows and columns are those of the heightmap.
pub fn points(
    heightmap: &Heightmap,
    header: std_msgs::Header,
) -> Result<sensor_msgs::PointCloud2, ConvertError> {
    const POINT_BYTES: usize = 16;
    let workspace = &heightmap.workspace;
    super::error::size("rgb", heightmap.rgb.len(), 3 * workspace.len())?;
    super::error::size("height_m", heightmap.height_m.len(), workspace.len())?;
    let field = |name: &str, offset| sensor_msgs::PointField {
        name: name.to_owned(),
        offset,
        datatype: sensor_msgs::PointField::FLOAT32,
        count: 1,
    };
    let mut data = Vec::with_capacity(POINT_BYTES * workspace.len());
    let colors = heightmap.rgb.as_chunks::<3>().0;
    for (index, (height_m, &[r, g, b])) in heightmap.height_m.iter().zip(colors).enumerate() {
        let center = workspace.center(Pixel {
            row: index / workspace.cols,
            col: index % workspace.cols,
        });
        for value in [center.x as f32, center.y as f32, *height_m] {
            data.extend_from_slice(&value.to_le_bytes());
        }
        data.extend_from_slice(&[b, g, r, 0]);
    }
    Ok(sensor_msgs::PointCloud2 {
        header,
        height: workspace.rows as u32,
        width: workspace.cols as u32,
        fields: vec![
            field("x", 0),
            field("y", 4),
            field("z", 8),
            field("rgb", 12),
        ],
        is_bigendian: false,
        point_step: POINT_BYTES as u32,
        row_step: (POINT_BYTES * workspace.cols) as u32,
        data: ByteBuf::from(data),
        is_dense: true,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::heightmap::Workspace;

    /// Reads a grid map as grid_map_core does: position of an index from the centre of the map.
    fn elevation_at(map: &grid_map_msgs::GridMap, x: f64, y: f64) -> f32 {
        let dims = &map.data[0].layout.dim;
        let (cols, rows) = (dims[0].size as usize, dims[1].size as usize);
        let row = ((map.info.pose.position.x + map.info.length_x / 2.0 - x) / map.info.resolution)
            as usize;
        let col = ((map.info.pose.position.y + map.info.length_y / 2.0 - y) / map.info.resolution)
            as usize;
        assert!(row < rows && col < cols);
        map.data[0].data[col * rows + row]
    }

    #[test]
    fn a_grid_map_shows_each_cell_where_it_is() {
        let workspace = Workspace {
            rows: 3,
            cols: 2,
            ..Workspace::RAVENS
        };
        let mut heightmap = Heightmap::new(workspace);
        heightmap.height_m = vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
        heightmap.rgb[0..3].copy_from_slice(&[1, 2, 3]);
        let map = grid_map(&heightmap, Default::default());
        for row in 0..3 {
            for col in 0..2 {
                let pixel = Pixel { row, col };
                let center = workspace.center(pixel);
                assert_eq!(
                    elevation_at(&map, center.x, center.y),
                    heightmap.height_at_m(pixel)
                );
            }
        }
        assert_eq!(map.data[1].data[5].to_bits(), 0x01_02_03);
    }

    #[test]
    fn a_point_cloud_has_a_colored_point_over_the_centre_of_each_cell() {
        let workspace = Workspace {
            rows: 3,
            cols: 2,
            ..Workspace::RAVENS
        };
        let mut heightmap = Heightmap::new(workspace);
        heightmap.height_m[3] = 0.125;
        heightmap.rgb[9..12].copy_from_slice(&[1, 2, 3]);
        let cloud = points(&heightmap, Default::default()).unwrap();
        assert_eq!(cloud.data.len() as u32, cloud.row_step * cloud.height);
        assert_eq!(cloud.row_step, cloud.point_step * cloud.width);
        let point = &cloud.data[3 * cloud.point_step as usize..][..cloud.point_step as usize];
        let value = |offset: u32| {
            let bytes = &point[offset as usize..][..4];
            f32::from_le_bytes(bytes.try_into().unwrap())
        };
        let offset = |name: &str| {
            let field = cloud.fields.iter().find(|field| field.name == name);
            field.unwrap().offset
        };
        let center = workspace.center(Pixel { row: 1, col: 1 });
        assert_eq!(value(offset("x")), center.x as f32);
        assert_eq!(value(offset("y")), center.y as f32);
        assert_eq!(value(offset("z")), 0.125);
        assert_eq!(value(offset("rgb")).to_bits(), 0x01_02_03);
    }

    #[test]
    fn a_compressed_preview_is_a_png_of_the_same_pixels() {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
            *byte = (index * 7 % 251) as u8;
        }
        let message = compressed_preview(&heightmap, Default::default()).unwrap();
        let png = image::load_from_memory(&message.data).unwrap();
        assert_eq!((png.width(), png.height()), (160, 320));
        assert_eq!(png.into_rgb8().into_raw(), heightmap.rgb);
        heightmap.rgb.pop();
        assert!(compressed_preview(&heightmap, Default::default()).is_err());
    }
}
