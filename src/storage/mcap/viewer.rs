//! What viewers draw: the world of a row as `foxglove.SceneUpdate`, the agents' poses as `foxglove.PosesInFrame`.
//!
//! Agents are spheres in the colour of their team, all else that has a place in the state is a flat grey cylinder. A
//! link is drawn as the half of the line that begins at its sender: green when the message was delivered, red when not.

use serde_json::Value;

use super::proto::foxglove::line_primitive::Type;
use super::proto::foxglove::{
    Color, CylinderPrimitive, LinePrimitive, Point3, Pose, PosesInFrame, Quaternion, SceneEntity, SceneUpdate,
    SpherePrimitive, Vector3,
};
use super::proto::google::protobuf::Timestamp;
use crate::schema::{Layout, Manifest};

/// Name of the coordinate frame.
const FRAME: &str = "world";
/// Radius of what the scenario gives none.
const RADIUS: f64 = 0.05;
/// Thickness of a link and height of a landmark, world units.
const THIN: f64 = 0.01;
/// Colours of teams, in order of appearance (Okabe and Ito's, which colour-blind people can tell apart).
const TEAMS: [[f64; 3]; 5] = [[0.0, 0.45, 0.7], [0.9, 0.6, 0.0], [0.8, 0.6, 0.7], [0.35, 0.7, 0.9], [0.95, 0.9, 0.25]];
const LANDMARK: [f64; 3] = [0.6, 0.6, 0.6];
const DELIVERED: [f64; 3] = [0.0, 0.62, 0.45];
const LOST: [f64; 3] = [0.84, 0.1, 0.11];

/// Something with a place.
#[derive(Debug)]
struct Thing {
    /// Where its x and y stand in the state.
    at: [usize; 2],
    radius: f64,
    color: [f64; 3],
}

/// Draws rows of one store.
#[derive(Debug)]
pub(super) struct Viewer {
    agents: Vec<Thing>,
    landmarks: Vec<Thing>,
    /// Places of the communicators among the agents.
    communicators: Vec<usize>,
}

impl Viewer {
    /// What can be drawn of the episodes of this manifest; `None` when an agent has no place in its state.
    pub(super) fn new(manifest: &Manifest, layout: &Layout) -> Option<Self> {
        let field = |name: &str, axis: &str| {
            let wanted = format!("{name}.{axis}");
            layout.state_fields.iter().position(|field| *field == wanted)
        };
        let place = |name: &str| Some([field(name, "x")?, field(name, "y")?]);
        let mut teams = Vec::new();
        let mut agents = Vec::new();
        for agent in &layout.agents {
            if !teams.contains(&&agent.team) {
                teams.push(&agent.team);
            }
            let team = teams.iter().position(|team| **team == agent.team)?;
            let kinds = [agent.team.trim_end_matches('s'), kind(&agent.name)];
            let radius = radius(&manifest.scenario, &kinds);
            agents.push(Thing { at: place(&agent.name)?, radius, color: TEAMS[team % TEAMS.len()] });
        }
        let names = layout.state_fields.iter().filter_map(|field| field.strip_suffix(".x"));
        let others = names.filter(|name| layout.agents.iter().all(|agent| agent.name != *name));
        let landmark = |name: &str| {
            let radius = radius(&manifest.scenario, &[kind(name), "obstacle"]);
            Some(Thing { at: place(name)?, radius, color: LANDMARK })
        };
        let landmarks = others.filter_map(landmark).collect();
        Some(Self { agents, landmarks, communicators: layout.communicators() })
    }

    /// The world of one row: its state, its link bits, its time in nanoseconds.
    pub(super) fn scene(&self, state: &[f64], link: &[bool], time: u64) -> SceneUpdate {
        let entity = |id: &str| SceneEntity {
            timestamp: Some(timestamp(time)),
            frame_id: FRAME.to_owned(),
            id: id.to_owned(),
            ..SceneEntity::default()
        };
        let sphere = |thing: &Thing| SpherePrimitive {
            pose: Some(pose(thing, state)),
            size: Some(Vector3 { x: 2.0 * thing.radius, y: 2.0 * thing.radius, z: 2.0 * thing.radius }),
            color: Some(color(thing.color)),
        };
        let cylinder = |thing: &Thing| CylinderPrimitive {
            pose: Some(pose(thing, state)),
            size: Some(Vector3 { x: 2.0 * thing.radius, y: 2.0 * thing.radius, z: THIN }),
            bottom_scale: 1.0,
            top_scale: 1.0,
            color: Some(color(thing.color)),
        };
        let agents = SceneEntity { spheres: self.agents.iter().map(sphere).collect(), ..entity("agents") };
        let landmarks = SceneEntity { cylinders: self.landmarks.iter().map(cylinder).collect(), ..entity("landmarks") };
        let links = SceneEntity { lines: self.lines(state, link), ..entity("links") };
        SceneUpdate { entities: vec![agents, landmarks, links] }
    }

    /// Delivered links, then lost ones.
    fn lines(&self, state: &[f64], link: &[bool]) -> Vec<LinePrimitive> {
        let n = self.communicators.len();
        let list = |wanted: bool, rgb: [f64; 3]| {
            let mut points = Vec::new();
            for (s, &sender) in self.communicators.iter().enumerate() {
                for (r, &receiver) in self.communicators.iter().enumerate() {
                    if s != r && link[s * n + r] == wanted {
                        let [from, to] = [sender, receiver].map(|a| self.agents[a].at.map(|at| state[at]));
                        let [x, y] = [0, 1].map(|axis| f64::midpoint(from[axis], to[axis]));
                        points.extend([[from[0], from[1]], [x, y]].map(|[x, y]| Point3 { x, y, z: 0.0 }));
                    }
                }
            }
            LinePrimitive {
                r#type: Type::LineList.into(),
                pose: Some(Pose { position: Some(Vector3::default()), orientation: Some(upright()) }),
                thickness: THIN,
                scale_invariant: false,
                points,
                color: Some(color(rgb)),
            }
        };
        let lines = [list(true, DELIVERED), list(false, LOST)];
        lines.into_iter().filter(|line| !line.points.is_empty()).collect()
    }

    /// The agents' poses.
    pub(super) fn poses(&self, state: &[f64], time: u64) -> PosesInFrame {
        let poses = self.agents.iter().map(|agent| pose(agent, state)).collect();
        PosesInFrame { timestamp: Some(timestamp(time)), frame_id: FRAME.to_owned(), poses }
    }
}

/// `landmark` of `landmark_0`.
fn kind(name: &str) -> &str {
    name.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches('_')
}

/// The scenario's parameter `<kind>_size`, the first that is there.
fn radius(scenario: &Value, kinds: &[&str]) -> f64 {
    kinds.iter().find_map(|kind| scenario.get(format!("{kind}_size"))?.as_f64()).unwrap_or(RADIUS)
}

fn pose(thing: &Thing, state: &[f64]) -> Pose {
    let [x, y] = thing.at.map(|at| state[at]);
    Pose { position: Some(Vector3 { x, y, z: 0.0 }), orientation: Some(upright()) }
}

fn upright() -> Quaternion {
    Quaternion { w: 1.0, ..Quaternion::default() }
}

fn color([r, g, b]: [f64; 3]) -> Color {
    Color { r, g, b, a: 1.0 }
}

fn timestamp(nanoseconds: u64) -> Timestamp {
    const SECOND: u64 = 1_000_000_000;
    Timestamp { seconds: (nanoseconds / SECOND) as i64, nanos: (nanoseconds % SECOND) as i32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::{AgentSpec, Controller};

    fn layout(fields: &[&str]) -> Layout {
        let agent = |name: &str, team: &str| AgentSpec {
            name: name.to_owned(),
            team: team.to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 1,
        };
        let agents = vec![agent("adversary_0", "predators"), agent("agent_0", "prey")];
        Layout { agents, state_fields: fields.iter().map(|&f| f.to_owned()).collect() }
    }

    fn viewer(fields: &[&str]) -> Option<Viewer> {
        let scenario = serde_json::json!({"predator_size": 0.075, "landmark_size": 0.2});
        let layout = layout(fields);
        Viewer::new(&Manifest::new(1, scenario, Value::Null, Value::Null, &layout), &layout)
    }

    const FIELDS: [&str; 7] =
        ["adversary_0.x", "adversary_0.y", "agent_0.x", "agent_0.y", "landmark_0.x", "landmark_0.y", "goal.agent_0"];

    #[test]
    fn things_stand_where_the_state_says_with_the_sizes_of_the_scenario() {
        let scene = viewer(&FIELDS).unwrap().scene(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0], &[true; 4], 1_100_000_000);
        let [agents, landmarks, links] = &scene.entities[..] else { panic!("{scene:?}") };
        let at = |pose: &Option<Pose>| pose.and_then(|p| p.position).map(|p| (p.x, p.y)).unwrap();
        let spheres: Vec<_> = agents.spheres.iter().map(|s| (at(&s.pose), s.size.unwrap().x)).collect();
        assert_eq!(spheres, [((1.0, 2.0), 0.15), ((3.0, 4.0), 0.1)]);
        assert_ne!(agents.spheres[0].color, agents.spheres[1].color);
        assert_eq!((at(&landmarks.cylinders[0].pose), landmarks.cylinders[0].size.unwrap().x), ((5.0, 6.0), 0.4));
        assert_eq!(links.timestamp, Some(Timestamp { seconds: 1, nanos: 100_000_000 }));
    }

    #[test]
    fn a_link_is_half_a_line_from_its_sender_in_the_colour_of_its_bit() {
        let scene = viewer(&FIELDS).unwrap().scene(&[0.0, 0.0, 2.0, 4.0, 0.0, 0.0, 0.0], &[true, false, true, true], 0);
        let lines = &scene.entities[2].lines;
        let ends = |line: &LinePrimitive| line.points.iter().map(|p| (p.x, p.y)).collect::<Vec<_>>();
        assert_eq!((ends(&lines[0]), lines[0].color), (vec![(2.0, 4.0), (1.0, 2.0)], Some(color(DELIVERED))));
        assert_eq!((ends(&lines[1]), lines[1].color), (vec![(0.0, 0.0), (1.0, 2.0)], Some(color(LOST))));
    }

    #[test]
    fn a_world_without_places_is_not_drawn() {
        assert!(viewer(&FIELDS[..3]).is_none());
    }
}
