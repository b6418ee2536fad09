// Where three.js puts the joints of BVH files:
//
//     node three_positions.mjs FOLDER-OF-THREE FILE.bvh ...    writes FILE.three.json beside each

import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

const [ three, ...files ] = process.argv.slice( 2 );
const load = ( path ) => import( pathToFileURL( join( three, path ) ).href );
const { AnimationMixer, LoopOnce, Vector3 } = await load( 'build/three.module.js' );
const { BVHLoader } = await load( 'examples/jsm/loaders/BVHLoader.js' );

for ( const file of files ) {

	const { skeleton, clip } = new BVHLoader().parse( readFileSync( file, 'utf8' ) );
	const joints = skeleton.bones.filter( ( bone ) => bone.name !== 'ENDSITE' );

	// Two tracks a joint. Bound by id: names are cut at blanks, and the mixer reads signs in them.
	clip.tracks.forEach( ( track, i ) => {

		track.name = joints[ i >> 1 ].uuid + track.name.slice( track.name.lastIndexOf( '.' ) );

	} );

	const mixer = new AnimationMixer( skeleton.bones[ 0 ] );
	const action = mixer.clipAction( clip ).setLoop( LoopOnce );
	action.clampWhenFinished = true;
	action.play();

	const times = clip.tracks[ 0 ].times;
	const frames = Array.from( times, ( time ) => {

		mixer.setTime( time );
		skeleton.bones[ 0 ].updateMatrixWorld( true );
		return joints.map( ( bone ) => bone.getWorldPosition( new Vector3() ).toArray() );

	} );
	const fps = times.length > 1 ? ( times.length - 1 ) / times[ times.length - 1 ] : null;
	writeFileSync( file.replace( /bvh$/, 'three.json' ), JSON.stringify( { fps, frames } ) );

}
