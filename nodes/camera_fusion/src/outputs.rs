//! The standard views of a heightmap (grid map, point cloud, image); each is made only while it has a subscriber.

use heightmap::Heightmap;
use msgs::{
    Interface,
    convert::{self, ConvertError},
    grid_map_msgs::GridMap,
    sensor_msgs::{CompressedImage, Image, PointCloud2},
    std_msgs::Header,
};
use node_kit::{Node, NodeError, Publisher, Qos};

/// A topic that is published while it has a subscriber. Late subscribers receive the latest heightmap.
struct OnDemand<M: Interface> {
    publisher: Publisher<M>,
    wanted: bool,
    /// The last heightmap has been shown.
    shown: bool,
    make: fn(&Heightmap, Header) -> Result<M, ConvertError>,
}

impl<M: Interface> OnDemand<M> {
    fn new(
        node: &Node,
        topic: &str,
        make: fn(&Heightmap, Header) -> Result<M, ConvertError>,
    ) -> Result<Self, NodeError> {
        Ok(Self {
            publisher: node.publisher(topic, Qos::Latched)?,
            wanted: false,
            shown: true,
            make,
        })
    }

    fn look(&mut self, node: &Node) {
        self.wanted = node.graph().subscriptions(self.publisher.topic()) > 0;
    }

    fn show(&mut self, last: Option<&(Heightmap, Header)>) {
        let Some((heightmap, header)) = last else {
            return;
        };
        if self.shown || !self.wanted {
            return;
        }
        self.shown = true;
        match (self.make)(heightmap, header.clone()) {
            Ok(message) => self.publisher.publish(message),
            Err(error) => self.publisher.statistics().reject(error),
        }
    }
}

/// The views of a heightmap beside the heightmap itself.
pub(crate) struct Outputs {
    grid_map: OnDemand<GridMap>,
    points: OnDemand<PointCloud2>,
    image: OnDemand<Image>,
    compressed: OnDemand<CompressedImage>,
    last: Option<(Heightmap, Header)>,
}

impl Outputs {
    pub(crate) fn new(node: &Node) -> Result<Self, NodeError> {
        Ok(Self {
            grid_map: OnDemand::new(node, "heightmap/grid_map", |heightmap, header| {
                Ok(convert::grid_map(heightmap, header))
            })?,
            points: OnDemand::new(node, "heightmap/points", convert::points)?,
            image: OnDemand::new(node, "heightmap/image", convert::preview_image)?,
            compressed: OnDemand::new(
                node,
                "heightmap/image/compressed",
                convert::compressed_preview,
            )?,
            last: None,
        })
    }

    /// Publishes a new heightmap on every view that had a subscriber at the last look.
    pub(crate) fn take(&mut self, heightmap: Heightmap, header: Header) {
        self.last = Some((heightmap, header));
        self.grid_map.shown = false;
        self.points.shown = false;
        self.image.shown = false;
        self.compressed.shown = false;
        self.show();
    }

    /// Looks for who listens, and shows them what they have not seen.
    pub(crate) fn look(&mut self, node: &Node) {
        self.grid_map.look(node);
        self.points.look(node);
        self.image.look(node);
        self.compressed.look(node);
        self.show();
    }

    fn show(&mut self) {
        let last = self.last.as_ref();
        self.grid_map.show(last);
        self.points.show(last);
        self.image.show(last);
        self.compressed.show(last);
    }
}
