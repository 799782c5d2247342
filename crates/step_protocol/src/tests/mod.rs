mod gate;
mod operator;
mod planner;
mod tracker;
