//! Three cameras of 0.3 megapixels over real DDS on loopback: images in, one heightmap out.

use std::time::{Duration, Instant};

use heightmap::{Camera, Intrinsics};
use msgs::{
    convert,
    sctn_msgs::Heightmap,
    sensor_msgs::{CameraInfo, Image},
    std_msgs::Header,
    tf2_msgs::TFMessage,
};
use node_kit::{Context, Network, NoParameters, Node, Publisher, Qos, RosArguments};
use tokio::time::timeout;

const LIMIT: Duration = Duration::from_secs(60);

struct CameraDriver {
    name: &'static str,
    color: Publisher<Image>,
    depth: Publisher<Image>,
    info: Publisher<CameraInfo>,
}

impl CameraDriver {
    fn new(node: &Node, name: &'static str) -> Self {
        let topic = |rest: &str| format!("{name}/{rest}");
        Self {
            name,
            color: node
                .publisher(&topic("color/image_raw"), Qos::Image)
                .unwrap(),
            depth: node
                .publisher(&topic("depth/image_rect_raw"), Qos::Image)
                .unwrap(),
            info: node
                .publisher(&topic("color/camera_info"), Qos::Image)
                .unwrap(),
        }
    }

    fn publish(&self, stamp: Duration) {
        let camera = Intrinsics::RAVENS;
        let header = convert::header(stamp, self.name).unwrap();
        let pixels = camera.width * camera.height;
        let rgb = vec![90; 3 * pixels];
        self.info
            .publish(convert::intrinsics_to_msg(header.clone(), &camera));
        self.color
            .publish(convert::color_to_msg(header.clone(), &camera, rgb).unwrap());
        self.depth
            .publish(convert::depth_to_msg(header, &camera, &vec![0.9; pixels]).unwrap());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn three_cameras_become_one_heightmap_in_time() {
    let context = Context::new(Network::unused().unwrap());
    let arguments = RosArguments::default();
    let fusion = camera_fusion::start(&context, &arguments).unwrap();
    let (node, _) = context.node::<NoParameters>("driver", &arguments).unwrap();
    let drivers = ["front", "left", "right"].map(|name| CameraDriver::new(&node, name));
    let transforms = node.publisher("/tf_static", Qos::Latched).unwrap();
    transforms.publish(TFMessage {
        transforms: Camera::ravens()
            .iter()
            .map(|camera| msgs::geometry_msgs::TransformStamped {
                header: Header {
                    frame_id: "world".into(),
                    ..Header::default()
                },
                child_frame_id: camera.name.clone(),
                transform: convert::isometry_to_msg(&camera.world_from_camera),
            })
            .collect(),
    });
    let mut heightmaps = node
        .subscription::<Heightmap>("heightmap", Qos::Latched)
        .unwrap();
    assert!(
        node.graph()
            .wait_for_subscription("/right/color/image_raw", LIMIT)
            .await
    );
    assert!(
        node.graph()
            .wait_for_subscription("/tf_static", LIMIT)
            .await
    );

    let mut latencies_ms = Vec::new();
    let mut stamp = Duration::from_secs(10);
    let start = Instant::now();
    while latencies_ms.len() < 10 {
        assert!(start.elapsed() < LIMIT, "no heightmaps: {latencies_ms:?}");
        stamp += Duration::from_millis(33);
        for driver in &drivers {
            driver.publish(stamp);
        }
        let sent = Instant::now();
        // Images are best effort: a set may be lost.
        let Ok(heightmap) = timeout(Duration::from_secs(1), heightmaps.recv()).await else {
            continue;
        };
        assert_eq!(
            (heightmap.views, heightmap.rows, heightmap.cols),
            (3, 320, 160)
        );
        if convert::time_from_msg(&heightmap.header.stamp).unwrap() == stamp {
            latencies_ms.push(sent.elapsed().as_secs_f64() * 1e3);
        }
    }
    latencies_ms.sort_by(f64::total_cmp);
    println!(
        "last image sent to heightmap received, median: {:.1} ms",
        latencies_ms[5]
    );
    context.shutdown();
    fusion.await.unwrap().unwrap();
}
